"""The notebooks run, and print what they hold, but for digits that depend on the processor."""

import re

import pytest

from tools.notebooks import FOLDER, read, run


def _outputs(notebook):
    """The kinds and the printed words of all outputs, without their numbers."""
    cells = [cell["outputs"] for cell in notebook["cells"] if cell["cell_type"] == "code"]
    return [[(o["output_type"], re.sub(r"[-\d.]+", "#", "".join(o.get("text", [])))) for o in cell] for cell in cells]


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.ipynb")), ids=lambda path: path.stem)
def test_a_notebook_gives_the_outputs_that_it_holds(path):
    held = read(path)
    assert any(_outputs(held)), f"{path.name} holds no outputs: run python -m tools.notebooks"
    given, shown = _outputs(run(held)), _outputs(held)
    # how many touches it takes until a mode is sure may depend on the processor: lines of one kind count once
    assert [[(kind, set(text.splitlines())) for kind, text in cell] for cell in given] == [
        [(kind, set(text.splitlines())) for kind, text in cell] for cell in shown
    ]
