"""Run the notebooks, and compare what they print with what is stored in them, or store it.

    python tools/notebooks.py compare [NAME...]     exit code 1 where a stored output is stale or missing
    python tools/notebooks.py write [NAME...]

A reader of the repository sees figures and printed results without running anything, so notebooks keep their outputs:
text, and pictures of at most `MAX_PICTURE` bytes. Compared are the words, numbers to `TOLERANCE`, and which cells show
a picture: pixels differ from one version of matplotlib to the next.
"""

from __future__ import annotations

import base64
import io
import re
import sys
import tempfile
from difflib import unified_diff
from pathlib import Path

import matplotlib.image
import nbformat
import numpy as np
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).resolve().parents[1] / "notebooks"
TOLERANCE = 0.01  # of a printed number: fits without a compiler differ in their last digits
MAX_PICTURE = 60_000
WIDTH = 760  # pixels of a stored picture: that of a column of text
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def run(path: Path) -> NotebookNode:
    """Return a notebook with the outputs of a run, as they are stored."""
    notebook = nbformat.read(path, as_version=4)
    NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(FOLDER)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = [kept for output in merge_streams(cell.outputs) if (kept := keep(output))]
    notebook.metadata = {"kernelspec": notebook.metadata.get("kernelspec", {}), "language_info": {"name": "python"}}
    return notebook


def merge_streams(outputs: list[NotebookNode]) -> list[NotebookNode]:
    """Join what is printed one piece after another."""
    merged: list[NotebookNode] = []
    for output in outputs:
        if output.output_type == "stream" and merged and merged[-1].get("name") == output.name:
            merged[-1].text += output.text
        else:
            merged.append(output)
    return merged


def keep(output: NotebookNode) -> NotebookNode | None:
    """Return an output as text and a small picture; None of what goes to the standard error, such as progress."""
    if output.output_type == "stream":
        output.text = hide_folder(output.text)
        return output if output.name == "stdout" else None
    data = {kind: output.data[kind] for kind in ("text/plain", "image/png") if kind in output.data}
    if "text/plain" in data:
        data["text/plain"] = hide_folder(data["text/plain"])
    if "image/png" in data:
        data = {"text/plain": "<Figure>", "image/png": shrink(data["image/png"])}
    output.data, output.metadata = NotebookNode(data), NotebookNode()
    return output


def shrink(picture: str) -> str:
    """Return a PNG in base64, at most `WIDTH` pixels wide: every n-th pixel's mean."""
    pixels = matplotlib.image.imread(io.BytesIO(base64.b64decode(picture)))[..., :3]
    factor = max(1, -(-pixels.shape[1] // WIDTH))
    height, width = (size // factor * factor for size in pixels.shape[:2])
    blocks = pixels[:height, :width].reshape(height // factor, factor, width // factor, factor, 3)
    small = np.round(blocks.mean(axis=(1, 3)) * 255 / 8) * 8  # 32 levels are enough for lines, and compress
    out = io.BytesIO()
    matplotlib.image.imsave(out, np.minimum(small, 255).astype(np.uint8), format="png", metadata={"Software": None})
    if out.tell() > MAX_PICTURE:
        raise SystemExit(f"a picture takes {out.tell()} bytes, {MAX_PICTURE} at most: draw less in it")
    return base64.b64encode(out.getvalue()).decode()


def hide_folder(text: str) -> str:
    """Leave out what another run names otherwise: temporary folders, and the time that a fit took."""
    return re.sub(r"(iterations), [\d.]+ m?s\b", r"\1", re.sub(rf"{tempfile.gettempdir()}/\w+", "folder", text))


def describe(cell: NotebookNode) -> list[str]:
    """Return what a cell shows, as text."""
    shown: list[str] = []
    for output in cell.get("outputs", []):
        data = output.get("data", {})
        shown.append("picture" if "image/png" in data else output.get("text", data.get("text/plain", "")))
    return shown


def agree(stored: str, fresh: str) -> bool:
    """Tell whether two texts have the same words and nearly the same numbers."""
    if NUMBER.sub("#", stored).split() != NUMBER.sub("#", fresh).split():
        return False
    pairs = zip(map(float, NUMBER.findall(stored)), map(float, NUMBER.findall(fresh)), strict=True)
    return all(abs(a - b) <= TOLERANCE * max(abs(a), abs(b)) for a, b in pairs)


def compare(path: Path, fresh: NotebookNode) -> list[str]:
    """Return where the stored outputs of a notebook differ from fresh ones."""
    stored, differences = nbformat.read(path, as_version=4), list[str]()
    for number, (old, new) in enumerate(zip(stored.cells, fresh.cells, strict=True), start=1):
        before, after = describe(old), describe(new)
        if len(before) != len(after) or not all(map(agree, before, after)):
            lines = ("\n".join(shown).splitlines() for shown in (before, after))
            changes = unified_diff(*lines, f"{path.name}, cell {number}, stored", "fresh", n=0, lineterm="")
            differences.append("\n".join(changes))
    return differences


def main(command: str, names: list[str]) -> int:
    """Compare or write the notebooks named, or all."""
    differences: list[str] = []
    for path in sorted(FOLDER.glob("*.ipynb")):
        if names and path.name not in names:
            continue
        fresh = run(path)
        if command == "write":
            nbformat.write(fresh, path)
        else:
            differences += compare(path, fresh)
        sys.stdout.write(f"{path.name} {'written' if command == 'write' else 'compared'}\n")
        sys.stdout.flush()
    if differences:
        sys.stdout.write("\n".join([*differences, "stale: look, then run python tools/notebooks.py write", ""]))
    return bool(differences)


if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in ("compare", "write"):
        raise SystemExit(__doc__)
    raise SystemExit(main(sys.argv[1], sys.argv[2:]))
