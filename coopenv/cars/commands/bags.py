"""`coopenv import`, `coopenv doctor`, `coopenv calibrate` and `coopenv identify`: bags of cars."""

from __future__ import annotations

from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import arguments, options
from coopenv.cli.run import check_log

if TYPE_CHECKING:
    from collections.abc import Sequence

    from coopenv.cars.bags.topics import TopicRow
    from coopenv.cars.calibration.calibrate import Calibrated, ConstantRow

in_bags = partial(typer.Argument, metavar="BAG...", callback=arguments.existing("bag"))


def import_(
    bags: Annotated[list[Path], in_bags(help="Bags of one drive, such as one per car.")],
    topics: options.TopicMap = None,
    out: Annotated[Path | None, typer.Option(help="MCAP file to write, a recording of coopenv.")] = None,
    seed: options.Seed = 0,
    overrides: options.Overrides = None,
    trust: options.Trust = None,
    observer: options.LogObserver = None,
    scene: options.LogScene = True,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing file.")] = False,
    propose: Annotated[
        Path | None, typer.Option(help="TOML file to write: a map of the topics, by their types and names.")
    ] = None,
    as_json: options.AsJson = False,
) -> None:
    """List the topics of ROS bags, and make a recording of them.

    Files and folders of ROS 1 and ROS 2. Without --map: rates, gaps and stamps of their topics; --propose writes a map.
    """
    if topics is not None and propose is not None:
        raise CoopenvError("--propose: writes a map, --map names one; give one of them")
    if topics is None:
        if out is not None or overrides:
            raise CoopenvError(
                f"{'--out' if out else '--override'}: needs the map of the bags' topics, --map topics.toml"
            )
        from coopenv.base.files import check_file, check_new, replace_text
        from coopenv.cars.bags.files import BagFile
        from coopenv.cars.bags.topics import examined, proposed

        if propose is not None:
            check_new(propose, force)
            check_file(propose)
        with ExitStack() as stack:
            files = [stack.enter_context(BagFile(path)) for path in bags]
            rows, notes = examined(files)
            text = "" if propose is None else proposed(files, rows)
        _print_topics(rows, as_json)
        console = options.console(stderr=as_json)
        for note in notes:
            console.print(note, soft_wrap=True)
        if propose is not None:
            replace_text(propose, text)
            console.print(f"{propose}: set its environment and markers", soft_wrap=True)
        return
    from coopenv.base.files import check_new
    from coopenv.cars.bags.bag import open_bags
    from coopenv.sources.selection import Selection

    if out is not None:
        check_log(out, observer, scene)
        check_new(out, force)
    bag = open_bags(bags, options.parse_overrides(overrides), topics, Selection(trust=tuple(trust or ())))
    _print_topics(bag.log.rows, as_json)
    ticks = bag.capabilities.ticks or 0
    seconds = (ticks - 1) / bag.scenario.rates.camera
    vehicles = len(bag.binding.cars)
    facts = f"{vehicles} vehicle{'s' * (vehicles > 1)}, {ticks} ticks, {seconds:.4g} s"
    if out is not None:
        from coopenv.runs.console import Progress
        from coopenv.runs.recorder import record as recorded
        from coopenv.runs.scenes import write_log

        log = options.console(stderr=True)
        with Progress(log, "recording", total=1.0) as progress:
            recording = recorded(bag, seed, on_progress=progress.update)
        write_log(recording, out, log, observer, scene)
    if not as_json:
        options.console().print(f"{out or bag.where}: {facts}", soft_wrap=True)


def _print_topics(rows: Sequence[TopicRow], as_json: bool) -> None:
    """Print the topics of bags and, where known, their roles."""
    if as_json:
        options.print_json([*rows])
        return
    from coopenv.cars.bags.clocks import written
    from coopenv.report.table import Table

    read = any(row.role for row in rows)
    names = ["topic", "read as" if read else "type"]
    numbers = [
        "messages",
        "rate\n[Hz]",
        *(["used"] if read else []),
        *("bad\nstamps", "longest\ngap [s]", "gaps", "clock\n[ms]"),
        *(["leads\n[ms]"] if read else []),
    ]
    table = Table.of_texts(names, numbers)
    for row in rows:
        about = (f"{row.car} {row.role}" if row.role else "") if read else row.type
        offset = None if row.offset is None else 1e3 * row.offset
        used = [(row.used, 0)] if read else []
        figures = [(row.rate, 1), *used, (row.outlying, 0), (row.gap, 3), (row.gaps, 0), (offset, 1)]
        shown = ("-" if value is None else f"{value:.{digits}f}" for value, digits in figures)
        lead = "-" if row.lead is None or row.lead_error is None else written(row.lead, row.lead_error)
        table.add(row.topic, about, str(row.messages), *shown, *([lead] if read else []))
    options.console().print(table)


def doctor(
    bags: Annotated[list[Path], in_bags(help="Bags of one drive, such as one per car.")],
    topics: Annotated[Path, typer.Option("--map", help="TOML file with the map of the bags' topics (docs/bags.md).")],
    overrides: options.Overrides = None,
    trust: options.Trust = None,
    as_json: options.AsJson = False,
) -> None:
    """Compare every stream of ROS bags with every other, and print which one the others contradict.

    The exit status is 1 if a finding refuses the drive.
    """
    import warnings

    from coopenv.base.errors import DataWarning
    from coopenv.cars.bags.bag import open_bags
    from coopenv.report.table import Table
    from coopenv.sources.selection import Selection

    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always", DataWarning)
        bag = open_bags(bags, options.parse_overrides(overrides), topics, Selection(trust=tuple(trust or ())))
    findings, console = bag.log.findings, options.console()
    known = [*bag.notes, *map(str, findings)]  # warnings too; the others are of files that were read in part
    lines = dict.fromkeys(str(each.message) for each in given)
    notes = [*(line for line in lines if not any(line.endswith(text) for text in known)), *bag.notes]
    if as_json:
        options.print_json({"findings": [*findings], "notes": notes})
    else:
        table = Table.of_texts(["stream", "contradiction", "mended by", "treatment"], [])
        for finding in findings:
            table.add(finding.subject, finding.text, finding.key, finding.treatment.value)
        console.print(table if findings else "No stream contradicts another.", soft_wrap=not findings)
        for note in notes:
            console.print(note, soft_wrap=True)
        read = [row for row in bag.log.rows if row.role]
        console.print(f"{bag.where}: {len(bag.binding.cars)} cars, {len(read)} topics", soft_wrap=True)
    if bag.refused:
        raise typer.Exit(1)


def calibrate(
    bags: Annotated[list[Path], in_bags(metavar="BAG...|FILE.mcap", help="Bags of one drive, or a log of coopenv.")],
    topics: options.TopicMap = None,
    out: Annotated[Path, typer.Option(help="Folder of calibration.toml and the figures.")] = Path("out", "calibration"),
    overrides: options.Overrides = None,
    no_truth: Annotated[bool, typer.Option("--no-truth", help="Leave out motion capture.")] = False,
    propose: Annotated[
        Path | None, typer.Option(help="Folder to write, without --map: environment and map, markers solved.")
    ] = None,
    like: Annotated[str, typer.Option(help="With --propose: environment with cameras and noise.")] = "svea_overtaking",
    as_json: options.AsJson = False,
) -> None:
    """Estimate cameras, odometry, clocks and markers of cars from one drive, and print which constants are wrong.

    With --propose the places of all markers are unknown: they are solved, with motion capture or without.
    """
    if propose is not None:
        if topics is not None or overrides:
            given = "--map" if topics is not None else "--override"
            raise CoopenvError(f"--propose: writes an environment and a map, {given} is for a map that is there")
        _survey(bags, like, propose, not no_truth, as_json)
        return
    from coopenv.base.files import check_file, new_folder, replace_text
    from coopenv.cars.bags.bag import open_bags
    from coopenv.cars.calibration.calibrate import calibrate as calibrated
    from coopenv.cars.calibration.calibrate import toml_text
    from coopenv.cars.calibration.drives import drive_of_recording, drive_of_streams
    from coopenv.cars.calibration.figure import residual_figure
    from coopenv.cars.doctor.finding import Treatment
    from coopenv.runs.console import Progress
    from coopenv.sources.registry import kind_of
    from coopenv.sources.sources import open_recording
    from coopenv.viz.style import save

    contradictions: list[str] = []
    with new_folder(out):
        check_file(out / "calibration.toml")
        if topics is not None:
            bag = open_bags(bags, options.parse_overrides(overrides), topics)
            found = (
                f for f in bag.log.findings if f.treatment in (Treatment.REFUSED, Treatment.MENDED, Treatment.TRUSTED)
            )
            contradictions += [str(finding) for finding in found]
            drive = drive_of_streams(bag.streams, bag.where)
        elif overrides:
            raise CoopenvError("--override: needs the map of the bags' topics, --map topics.toml")
        elif len(bags) > 1 or not kind_of(bags[0]).reader:
            raise CoopenvError(f"{bags[0]}: needs the map of its topics, --map topics.toml; a log of coopenv does not")
        else:
            drive = drive_of_recording(open_recording(bags[0]), bags[0])
        with Progress(options.console(stderr=True), "calibrating"):
            result = calibrated(drive, not no_truth)
    files = [out / "calibration.toml"]
    replace_text(files[0], toml_text(result))
    files += [save(residual_figure(result, c), out / f"residuals_{car.name}.png") for c, car in enumerate(drive.cars)]
    if as_json:
        printed = {name: getattr(result, name) for name in ("rows", "findings", "notes", "noise")}
        options.print_json({**printed, "contradictions": contradictions})
    else:
        _print_calibrated(result, files, contradictions)
    if not result.explained:
        raise typer.Exit(1)


def _survey(bags: Sequence[Path], like: str, folder: Path, truth: bool, as_json: bool) -> None:
    """Solve markers, write the files and print a table."""
    from coopenv.base.files import new_folder
    from coopenv.cars.calibration.survey import survey
    from coopenv.report.table import Table
    from coopenv.runs.console import Progress

    with new_folder(folder), Progress(options.console(stderr=True), "solving markers"):
        result = survey(bags, like, folder, truth)
    if as_json:
        options.print_json({"markers": result.markers, "sightings": result.sightings, "truth": result.truth})
        return
    table = Table.of_texts(["marker", "is", "finding"], ["frames", "x [m]", "y [m]", "z [m]", "std. error [m]"])
    for m in result.markers:
        error = f"{max(m.error):.2g}" if m.error else "-"
        place = [f"{value:.3f}" for value in m.position] or ["-"] * 3
        table.add(str(m.number), m.name, m.finding, str(m.frames), *place, error)
    console = options.console()
    console.print(table)
    if not result.truth:
        console.print("No motion capture: the origin is the first car's start.")
    console.print(f"Files: {', '.join(map(str, result.files))}", soft_wrap=True)
    console.print(f"Next: coopenv run {bags[0]} --map {result.files[1]}", soft_wrap=True)


def _print_calibrated(result: Calibrated, files: Sequence[Path], contradictions: Sequence[str]) -> None:
    _print(result.rows)
    console = options.console()
    if any(car.lens is None for car in result.batch.cars):
        console.print("Bearings without pixels: intrinsics cannot be estimated.")
    if result.noise:
        console.print("Measured noise: " + ", ".join(f"{name} = {value:.3g}" for name, value in result.noise.items()))
    for line in (*((*result.findings, *contradictions) or ("No constant is wrong.",)), *result.notes):
        console.print(line, soft_wrap=True)
    console.print(f"Files: {', '.join(map(str, files))}", soft_wrap=True)


def identify(
    bags: Annotated[list[Path], in_bags(help="Bags of one drive, with the commands.")],
    topics: options.TopicMap = None,
    car: Annotated[str | None, typer.Option(help="Name of the car (default: the first one with commands).")] = None,
    out: Annotated[Path, typer.Option(help="File of the result.")] = Path("identified.toml"),
    overrides: options.Overrides = None,
    as_json: options.AsJson = False,
) -> None:
    """Estimate actuation, noise and links of a car from one drive, for fake cars that behave like it.

    A deployment file takes the result as `identified`. The second table compares the bag with fakes that get the same
    commands: Kolmogorov-Smirnov distances, 0 to 1, for the environment as it is, for the result, and by chance.
    """
    from coopenv.base.files import check_file, replace_text
    from coopenv.cars.bags.bag import open_bags
    from coopenv.cars.calibration.identify import identify as identified
    from coopenv.cars.calibration.identify import toml_text
    from coopenv.report.table import Table
    from coopenv.runs.console import Progress

    check_file(out)
    bag = open_bags(bags, options.parse_overrides(overrides), topics)
    with Progress(options.console(stderr=True), "identifying"):
        result = identified(bag, car)
    replace_text(out, toml_text(result))
    if as_json:
        options.print_json({"car": result.car, "rows": result.rows, "distances": result.distances})
        return
    _print(result.rows)
    table = Table.of_texts(["quantity"], ["samples", "as given", "identified", "by chance"])
    for row in result.distances:
        table.add(row.quantity, str(row.samples), *(f"{d:.3f}" for d in (row.given, row.identified, row.seeds)))
    console = options.console()
    console.print(table)
    console.print(f"File: {out}", soft_wrap=True)


def _print(rows: Sequence[ConstantRow]) -> None:
    """Print a table of constants."""
    from coopenv.report.table import Table

    table = Table.of_texts(["constant", "unit", "finding"], ["given", "estimate", "std. error"])
    for row in rows:
        table.add(row.name, row.unit, row.finding, f"{row.given:.5g}", f"{row.value:.5g}", f"{row.error:.2g}")
    options.console().print(table)
