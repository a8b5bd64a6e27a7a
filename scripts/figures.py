"""The published figures of divergence, drawn anew with what was run over the exact prediction.

    python scripts/figures.py --list
    python scripts/figures.py                                  # all of them, into runs/figures
    python scripts/figures.py sb-11-2 spiral --out pictures --format svg --no-caption

Every figure is made with fixed seeds and says under it what is exact, what is sampled, with which settings, and who
published it; ``--no-caption`` leaves that to the page around it. It needs matplotlib. All of them take a minute or two:

    sb-11-2          Off-policy TD(0) diverges on Baird's star            1.3 s   sb-11-2.svg sb-11-2.png
    ...
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from neuralq.checks import MissingExtra
from neuralq.lab.figures import FIGURES, Drawing, png_of, svg_of


def write(drawing: Drawing, folder: Path, formats: list[str], with_caption: bool) -> list[str]:
    """Writes the files of one figure and returns their names."""
    written = []
    for kind in formats:
        path = folder / f"{drawing.name}.{kind}"
        if kind == "svg":
            path.write_text(svg_of(drawing, with_caption) + "\n", encoding="utf-8")
        else:
            path.write_bytes(png_of(drawing, with_caption))
        written.append(path.name)
    return written


def formats_of(text: str) -> list[str]:
    """``"svg,png"`` as a list."""
    kinds = [kind.strip() for kind in text.split(",") if kind.strip()]
    unknown = [kind for kind in kinds if kind not in ("svg", "png")]
    if unknown or not kinds:
        raise argparse.ArgumentTypeError(f"formats are svg and png, separated by a comma; got {text!r}")
    return kinds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="figures to draw (default: all)")
    parser.add_argument("--out", type=Path, default=Path("runs/figures"), metavar="DIR", help="(default runs/figures)")
    parser.add_argument("--format", type=formats_of, default=["svg", "png"], help="svg, png or both (default svg,png)")
    parser.add_argument("--no-caption", action="store_true", help="leave out the text under the figure")
    parser.add_argument("--list", action="store_true", help="print the names and stop")
    options = parser.parse_args()
    unknown = [name for name in options.names if name not in FIGURES]
    if unknown:
        parser.error(f"no figure is called {unknown[0]!r}; there are {', '.join(FIGURES)}")
    if options.list:
        for name, make in FIGURES.items():
            print(f"{name:<16} {(make.__doc__ or '').splitlines()[0]}")
        return
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.names or FIGURES:
        began = time.perf_counter()
        drawing = FIGURES[name]()
        try:
            written = write(drawing, options.out, options.format, not options.no_caption)
        except MissingExtra as error:
            raise SystemExit(str(error)) from error
        seconds = time.perf_counter() - began
        print(f"{name:<16} {drawing.title:<58} {seconds:5.1f} s   {' '.join(written)}", flush=True)


if __name__ == "__main__":
    main()
