"""``python -m tools.notebooks [NAME ...]``: runs the notebooks of docs/notebooks and writes their outputs into them.

Code cells run in one namespace, in a folder of their own that is gone afterwards. What they print and the figures they leave open
are their outputs.
"""

from __future__ import annotations

import base64
import contextlib
import io
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt

FOLDER = Path(__file__).parents[1] / "docs" / "notebooks"
_DPI = 80


def run(notebook: dict[str, Any]) -> dict[str, Any]:
    """``notebook`` with the outputs of its code cells made anew."""
    names: dict[str, Any] = {"__name__": "__main__"}
    cells, count = [], 0
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for cell in notebook["cells"]:
            if cell["cell_type"] == "code":
                count += 1
                cell = cell | {"execution_count": count, "outputs": _outputs("".join(cell["source"]), names)}
            cells.append(cell)
    return notebook | {"cells": cells}


def _outputs(code: str, names: dict[str, Any]) -> list[dict[str, Any]]:
    """What ``code`` prints, and the figures that it leaves open."""
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(code, "<cell>", "exec"), names)
    found: list[dict[str, Any]] = []
    if printed.getvalue():
        found.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue().splitlines(keepends=True)})
    for number in plt.get_fignums():
        image = io.BytesIO()
        plt.figure(number).savefig(image, format="png", dpi=_DPI, metadata={"Software": None})
        plt.close(number)
        data = {"image/png": base64.b64encode(image.getvalue()).decode(), "text/plain": ["<Figure>"]}
        found.append({"output_type": "display_data", "data": data, "metadata": {}})
    return found


def read(path: Path) -> dict[str, Any]:
    """The notebook in a file."""
    content = json.loads(path.read_text(encoding="utf-8"))
    assert isinstance(content, dict)
    return content


def main(names: list[str]) -> None:
    """Run the notebooks of these names, all without any."""
    for path in sorted(FOLDER.glob("*.ipynb")):
        if not names or path.stem in names:
            path.write_text(json.dumps(run(read(path)), indent=1) + "\n", encoding="utf-8")
            print(path)


if __name__ == "__main__":
    main(sys.argv[1:])
