"""`coopenv calibrate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import options


def calibrate(
    bags: Annotated[
        list[Path], typer.Argument(metavar="BAG...|FILE.mcap", help="Bags of one drive, or a log of coopenv.")
    ],
    topics: options.TopicMap = None,
    out: Annotated[Path, typer.Option(help="Folder of calibration.toml and the figures.")] = Path("out", "calibration"),
    overrides: options.Overrides = None,
    no_truth: Annotated[bool, typer.Option("--no-truth", help="Leave out motion capture.")] = False,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")] = False,
    as_json: options.AsJson = False,
) -> None:
    """Estimate cameras, odometry, clocks and markers of cars from one drive, and print which constants are wrong."""
    from coopenv.backends.sources import SourceKind, kind_of, open_bags, open_recording
    from coopenv.base.files import check_file, new_folder, replace_text
    from coopenv.cars.calibration.drives import drive_of_bag, drive_of_recording
    from coopenv.cars.calibration.findings import calibrate as calibrated
    from coopenv.cars.calibration.findings import toml_text
    from coopenv.runs.console import Progress, number_table

    with new_folder(out):
        check_file(out / "calibration.toml")
        if topics is not None:
            drive = drive_of_bag(open_bags(bags, topics, options.parse_overrides(overrides)))
        elif overrides:
            raise CoopenvError("--set: needs the map of the bags' topics, --map topics.toml")
        elif len(bags) > 1 or kind_of(bags[0]) is not SourceKind.LOG:
            raise CoopenvError(f"{bags[0]}: needs the map of its topics, --map topics.toml; a log of coopenv does not")
        else:
            drive = drive_of_recording(open_recording(bags[0]), bags[0])
        with Progress(options.console(stderr=True), "calibrating"):
            result = calibrated(drive, not no_truth)
    files = [out / "calibration.toml"]
    replace_text(files[0], toml_text(result))
    if not no_figures:
        from coopenv.viz.calibration_figures import residual_figure
        from coopenv.viz.style import save

        files += [
            save(residual_figure(result, c), out / f"residuals_{car.name}.png") for c, car in enumerate(drive.cars)
        ]
    if as_json:
        options.print_json({"rows": result.rows, "findings": result.findings, "noise": result.noise})
        return
    table = number_table(["constant", "unit", "finding"], ["given", "estimate", "std. error"])
    for row in result.rows:
        table.add_row(row.name, row.unit, row.finding, f"{row.given:.5g}", f"{row.value:.5g}", f"{row.error:.2g}")
    console = options.console(least=100)
    console.print(table)
    if any(car.lens is None for car in drive.cars):
        console.print("Bearings without pixels: intrinsics cannot be estimated.")
    console.print("Measured noise: " + ", ".join(f"{name} = {value:.3g}" for name, value in result.noise.items()))
    for line in result.findings or ("No constant is wrong.",):
        console.print(line, soft_wrap=True)
    console.print(f"Files: {', '.join(map(str, files))}", soft_wrap=True)
