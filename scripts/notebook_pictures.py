"""Takes one picture of each notebook that was run into `docs/images/notebooks`, small, for its first cell to show.

The repository keeps notebooks without outputs; a reader on GitHub sees these. Run the notebooks in a copy first (as
`.ci/run` does), then `python scripts/notebook_pictures.py COPY`.
"""

from __future__ import annotations

import argparse
import base64
import io
from pathlib import Path

import nbformat
from PIL import Image

FOLDER = Path(__file__).parents[1] / "docs" / "images" / "notebooks"
SHOWN = {1: 1, 2: 1, 3: 1, 4: 1, 5: 1, 6: 0, 7: 0}
"""Which of its pictures stands for a notebook, by the notebook's number."""
WIDTH = 820


def pictures_of(file: Path) -> list[Image.Image]:
    """Returns the pictures among the outputs of a notebook, in their order."""
    cells = nbformat.read(file, as_version=4).cells
    outputs = [output.get("data", {}) for cell in cells for output in cell.get("outputs", [])]
    return [Image.open(io.BytesIO(base64.b64decode(data["image/png"]))) for data in outputs if "image/png" in data]


def write_picture(file: Path, folder: Path = FOLDER) -> Path | None:
    """Writes the picture that stands for a notebook; None if it has none, since it was not run."""
    number, found = int(file.stem.split("_")[0]), pictures_of(file)
    if len(found) <= SHOWN[number]:
        return None
    picture = found[SHOWN[number]].convert("RGB")
    picture.thumbnail((WIDTH, WIDTH), Image.Resampling.LANCZOS)
    folder.mkdir(parents=True, exist_ok=True)
    written = folder / f"{number}.png"
    picture.save(written, optimize=True)  # a palette would merge the colours of outcomes
    return written


def main() -> None:
    """Writes the pictures of the notebooks of a folder."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with notebooks that were run")
    for file in sorted(parser.parse_args().folder.glob("*.ipynb")):
        written = write_picture(file)
        print(f"{file.name}: {written or 'has no such picture; it was not run'}")


if __name__ == "__main__":
    main()
