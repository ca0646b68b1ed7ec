"""Make `python -m canwall` the command `canwall`."""

from canwall.cli import main

if __name__ == "__main__":
    main()
