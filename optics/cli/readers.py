"""The command that reads images as a robot would."""

import re
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer

from optics.cli.shared import AsJson, Force, command, show, terminal
from optics.words import number, table


class Reader(str, Enum):
    """What is read."""

    markers = "markers"
    proximity = "proximity"
    grid = "grid"
    ssim = "ssim"


# what each reader takes besides images, and whether it must be given
TAKES: dict[str, dict[str, bool]] = {
    "markers": {"--reference": False, "--matrix": False},
    "proximity": {"--reference": True, "--threshold": False, "--curve": False, "--reference-area": False},
    "grid": {"--reference": True},
    "ssim": {"--reference": True},
}
REFERENCE = {
    "proximity": "the same view without the object",
    "grid": "images, or a folder of them, with nothing near; the source takes 30",
    "ssim": "the image to compare with",
}


@command
def read(
    what: Annotated[Reader, typer.Argument(metavar="WHAT", help="markers, proximity, grid or ssim.")],
    files: Annotated[list[Path], typer.Argument(metavar="FILES...", help="Images, or folders of them.")],
    reference: Annotated[
        list[Path] | None,
        typer.Option(
            "--reference",
            metavar="PATH",
            help="markers: the image at rest, to give motions. proximity: the same view without the object. grid: "
            "images or a folder with nothing near, repeatable. ssim: the image to compare with.",
        ),
    ] = None,
    matrix: Annotated[
        str | None, typer.Option("--matrix", metavar="COLUMNSxROWS", help="markers: number them row by row, as in 5x4.")
    ] = None,
    threshold: Annotated[
        float | None,
        typer.Option(
            "--threshold",
            help="proximity: detect the object where a pixel differs by so many sd of its noise.",
            min=0.0,
        ),
    ] = None,
    curve: Annotated[
        Path | None,
        typer.Option(
            "--curve",
            metavar="CSV",
            help="proximity: r and distance (mm) of a reference object, as this command wrote them with -o and you "
            "added the distances; gives distances.",
        ),
    ] = None,
    reference_area: Annotated[
        float | None,
        typer.Option(
            "--reference-area",
            metavar="PX",
            help="proximity: area of the reference object where it was first detected.",
            show_default="that of the first image with an object",
            min=0.0,
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE.csv", help="Also write the table here.")
    ] = None,
    force: Force = False,
    as_json: AsJson = False,
) -> None:
    """Read images as a robot would.

    markers: Vi2TaP's; proximity: its metric r and the distance; grid: MagicTac's Algorithms 1 to 3; ssim: structural
    similarity, mean absolute difference (of full scale) and PSNR. Columns are px, mm, bit and dB."""
    from optics.files.output import claim
    from optics.study import readout

    _fit_together(
        what.value,
        {
            "--reference": reference,
            "--matrix": matrix,
            "--threshold": threshold,
            "--curve": curve,
            "--reference-area": reference_area,
        },
    )
    if output is not None:
        if output.suffix.lower() != ".csv":
            raise ValueError(f"-o {output}: '{output.suffix}' is no table; allowed: a name ending in .csv")
        claim([output], force)
    found = readout.images(files)
    still = readout.images(reference or [])
    if what is not Reader.grid and len(still) > 1:
        raise ValueError(f"--reference: {len(still)} images; allowed: one")
    one = next(iter(still.values()), None)
    with terminal.progress() as progress:
        if what is Reader.markers:
            rows = readout.markers(found, one, _matrix(matrix), progress)
        elif what is Reader.grid:
            rows = readout.grid(found, still, progress=progress)
        else:
            assert one is not None  # `_fit_together`
            if what is Reader.ssim:
                rows = readout.likeness(found, one, progress)
            else:
                mm = None if curve is None else readout.curve_of(curve)
                rows = readout.proximity(found, one, threshold, mm, reference_area, progress)
    if output is not None:
        _write(output, rows)
    if as_json:
        return show(rows)
    if not rows:
        terminal.note("nothing found")
        return
    head = list(rows[0])
    print(table([head, *([_cell(row[name]) for name in head] for row in rows)]))


def _fit_together(what: str, given: dict[str, Any]) -> None:
    """Raises ValueError for an option that the reader does not take, and for one that it needs."""
    takes = TAKES[what]
    for option, value in given.items():
        if value is not None and option not in takes:
            raise ValueError(f"{option}: without effect on '{what}'; allowed there: {', '.join(takes)}; leave it out")
        if value is None and takes.get(option):
            raise ValueError(f"optics read {what}: no {option}; give {REFERENCE[what]}")


def _matrix(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,3})x(\d{1,3})", text.strip())
    if match is None or min(int(match[1]), int(match[2])) < 2:
        raise ValueError(f"--matrix {text}: allowed: COLUMNSxROWS, 2x2 to 999x999, such as 5x4")
    return int(match[1]), int(match[2])


def _cell(value: object) -> str:
    return "-" if value is None else value if isinstance(value, str) else number(value, 6)  # type: ignore[arg-type]


def _write(output: Path, rows: list[dict[str, object]]) -> None:
    import csv
    import io

    from optics.files.output import write_text

    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]) if rows else ["file"], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_text(output, text.getvalue())
    terminal.note(str(output))
