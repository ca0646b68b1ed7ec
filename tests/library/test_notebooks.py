"""The notebooks of the documentation: executed, small, and still what they say."""

import json
from pathlib import Path
from typing import Any

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parents[2] / "docs" / "notebooks").glob("*.ipynb"))


def results(notebook: Any) -> list[list[tuple[str, str]]]:
    """The kinds and texts of output of each cell, without what goes to standard error."""
    return [
        sorted(
            (kind, "" if kind == "image/png" else content)
            for output in cell.outputs
            if output.get("name") != "stderr"
            for kind, content in output.get(
                "data", {output.get("name", ""): output.get("text", "")}
            ).items()
        )
        for cell in notebook.cells
        if cell.cell_type == "code"
    ]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_kept_executed_and_small(path: Path) -> None:
    notebook = nbformat.read(path, 4)
    nbformat.validate(notebook)
    assert path.stat().st_size < 300_000
    counts = [cell.execution_count for cell in notebook.cells if cell.cell_type == "code"]
    assert counts == list(range(1, len(counts) + 1))
    assert not notebook.metadata.get("widgets")
    written = json.dumps([cell.get("outputs") for cell in notebook.cells])
    assert "/tmp/" not in written
    assert "image/png" in written


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_executes_to_the_same_results(path: Path, tmp_path: Path) -> None:
    kept = nbformat.read(path, 4)
    notebook = nbformat.read(path, 4)
    resources = {"metadata": {"path": str(tmp_path)}}
    NotebookClient(notebook, timeout=240, resources=resources).execute()
    assert results(notebook) == results(kept)
