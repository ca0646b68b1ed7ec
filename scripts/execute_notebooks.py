"""Execute the notebooks in docs/notebooks and write them back, without what differs each time."""

import argparse
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

NOTEBOOKS = Path(__file__).parents[1] / "docs" / "notebooks"


def execute(path: Path) -> None:
    """Execute a notebook in a folder of its own; leave out what went to standard error."""
    notebook = nbformat.read(path, 4)
    metadata = notebook.metadata.copy()
    with tempfile.TemporaryDirectory() as folder:
        resources = {"metadata": {"path": folder}}
        NotebookClient(notebook, timeout=240, resources=resources, record_timing=False).execute()
    notebook.metadata = metadata
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [each for each in cell.outputs if each.get("name") != "stderr"]
    nbformat.write(notebook, path)


def main() -> None:
    """Execute the notebooks that the command line names."""
    names = sorted(path.stem for path in NOTEBOOKS.glob("*.ipynb"))
    parser = argparse.ArgumentParser(prog="scripts/notebooks", description=__doc__)
    parser.add_argument("notebooks", nargs="*", metavar="NAME", help=", ".join(names))
    given = parser.parse_args().notebooks
    for name in given:
        if name not in names:
            parser.error(f"no notebook {name}; there are {', '.join(names)}")
    for name in given or names:
        print(name, flush=True)
        execute(NOTEBOOKS / f"{name}.ipynb")


if __name__ == "__main__":
    main()
