"""The notebook runs from its first cell to its last, on any run."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

NOTEBOOK = Path(__file__).parents[2] / "notebooks" / "analysis.ipynb"


@pytest.mark.slow
def test_it_runs(opinionated_run, tmp_path):
    reason = "needs the extra `analysis`"
    nbclient = pytest.importorskip("nbclient", reason=reason)
    nbformat = pytest.importorskip("nbformat", reason=reason)
    pytest.importorskip("pandas", reason=reason)

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    first = next(cell for cell in notebook.cells if cell.cell_type == "code")
    (name,) = re.findall(r'^RUN = "(.*)"', first.source, re.MULTILINE)
    assert (NOTEBOOK.parent / name / "config.json").exists()
    first.source = first.source.replace(name, str(opinionated_run))
    nbclient.NotebookClient(
        notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    outputs = [out for cell in notebook.cells for out in cell.get("outputs", ())]
    assert sum("image/png" in out.get("data", ()) for out in outputs) == 3
    assert not [out for out in outputs if out.get("name") == "stderr"]
    loaded = outputs[0]["text"]
    assert loaded.startswith("tdanet split 18/4")


def test_it_is_committed_with_the_outputs_of_a_run_and_without_local_paths():
    text = NOTEBOOK.read_text()
    code = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert all(out["output_type"] != "error" for cell in code for out in cell["outputs"])
    assert len(text) < 400_000
    assert "/home/" not in text
    assert "/tmp/" not in text
