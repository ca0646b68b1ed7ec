# Sourced by the scripts beside it: a virtual environment in the checkout, made when needed.
# `set_up_environment EXTRAS` sets $root and $bin; EXTRAS is "[plot,sweep]" or "[dev]". All versions are
# those of constraints.txt, so that every checkout has the same.

root=$(CDPATH='' cd -- "$(dirname -- "$0")/.." && pwd)
bin=$root/.venv/bin

set_up_environment() {
  # What an environment holds is noted in it; it is made anew where the checkout was moved, and
  # completed where pyproject.toml or constraints.txt have changed or more is asked for than was installed.
  constraints=$root/scripts/constraints.txt
  state="$root $(cat "$root/pyproject.toml" "$constraints" | cksum)"
  for extra in "[dev]" "$1"; do
    note=$root/.venv/installed$extra
    if [ -f "$note" ] && [ "$(cat "$note")" = "$state" ]; then
      return
    fi
  done
  (
    # Two first starts at once take turns.
    if command -v flock >/dev/null; then
      flock 9
    fi
    python=$(find_python)
    echo "canwall: setting up $root/.venv (first start)" >&2
    if ! [ -x "$bin/python" ] || ! "$bin/python" -c '' 2>/dev/null || ! grep -qsF "$root" "$root"/.venv/installed*; then
      "$python" -m venv --clear "$root/.venv"
    fi
    # uv does in seconds what takes pip a minute, but does not know where pip is told to look.
    { pip_install uv && "$bin/uv" pip install --python "$bin/python" --constraint "$constraints" \
      --editable "$root$1"; } >/dev/null 2>&1 || pip_install --editable "$root$1" >&2
    printf '%s' "$state" >"$root/.venv/installed$1"
  ) 9>"$root/.venv.lock"
}

pip_install() {
  "$bin/python" -m pip install --quiet --disable-pip-version-check --constraint "$constraints" "$@"
}

as_root() {
  if [ "$(id -u)" -eq 0 ]; then
    "$@"
  else
    sudo -n "$@"
  fi
}

find_python() {
  for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
    if command -v "$candidate" >/dev/null &&
      "$candidate" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
      echo "$candidate"
      return
    fi
  done
  echo "canwall: Python 3.11 or newer with venv is needed; install it (Debian: python3-venv)" >&2
  exit 2
}
