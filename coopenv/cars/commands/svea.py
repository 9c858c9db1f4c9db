"""`coopenv svea`: cars, real ones and fakes. Commands import what they need when they run."""

import gc
import os
import signal
import sys
import threading
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from math import isnan
from pathlib import Path
from typing import Annotated

import typer

from coopenv.base.errors import CoopenvError
from coopenv.cli import arguments, commands, options

in_deployment = partial(typer.Argument, metavar="DEPLOYMENT.toml", callback=arguments.existing("deployment"))
Fleet = Annotated[Path, in_deployment(help="Deployment of the fleet.")]
CarName = Annotated[str, typer.Option(help="Name of the car, as in the deployment.")]
GateConnect = Annotated[
    str | None,
    typer.Option(
        help="Router of the car's zenoh-bridge-ros2dds, in place of the deployment's gate.connect "
        "[default: tcp/127.0.0.1:7447].",
        show_default=False,
    ),
]
OffBoard = Annotated[
    bool,
    typer.Option("--off-board", help="Allow a router that is not on this computer, for trials beside a car."),
]
Station = Annotated[
    str | None,
    typer.Option(
        help="Station whose commands the car obeys [default: the deployment's security.identity, or station]; the car "
        "itself where `coopenv svea run --car` drives it.",
        show_default=False,
    ),
]

svea = commands.group("SVEA cars, real ones and fakes.")
HARMED = 1
"""Exit status of an attack that got through."""
STOPPED = 3
"""Exit status of a run that was stopped: by the watchdog, a person or another station."""


@svea.command()
def demo(
    environment: Annotated[
        str | None, typer.Option(help="The experiment: svea_overtaking (default) or svea_crossing.")
    ] = None,
    fleet: Annotated[
        Path | None, typer.Option(help="Or a deployment file of your own, whose cars are fakes (fakes = true).")
    ] = None,
    port: Annotated[
        int | None, typer.Option(min=1, max=65535, help="Port of the router of --real-time (default: a free one).")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder of the results (default: out/NAME of environment or file); the drive is beside it."),
    ] = None,
    policy: options.PolicyName = "route_follower",
    seed: options.Seed = 0,
    seconds: Annotated[
        float, typer.Option(min=0.0, help="Continue with further seeds up to this driving time, s.")
    ] = 0.0,
    beside: Annotated[
        bool, typer.Option("--beside", help="Simulate the same seeds, too, and print both side by side.")
    ] = False,
    real_time: Annotated[bool, typer.Option("--real-time", help="Run a process per car, and a router.")] = False,
    overrides: options.Overrides = None,
) -> None:
    """Let fake cars drive an experiment: table, figures, and a drive that can be run again.

    Cars, gates and station run in lockstep on a simulated clock, so that a busy computer takes longer and stops no car.
    The first time kernels are compiled, which takes a minute or two. The exit status is 3 where the watchdog stopped
    the cars.
    """
    from coopenv.cars.commands.demo import Demo

    if environment is not None and fleet is not None:
        raise CoopenvError(f"--environment: {fleet} names one; give --environment or --fleet")
    name = (environment or "svea_overtaking") if fleet is None else fleet.stem
    folder = out or Path("out") / name
    chosen = Demo(name, folder, policy, seed, options.parse_overrides(overrides), seconds, beside, fleet, real_time)
    if not chosen.run(port, options.console(stderr=True), options.console()):
        raise typer.Exit(STOPPED)


@svea.command()
def fake(
    deployment: Fleet,
    car: CarName,
    seed: options.Seed = 0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME[=VALUE][@START[+DURATION]]",
            help="Fault with its start and duration in s, e.g. loss=0.2@5+10. Kinds: freeze, kill, loss, "
            "delay, clock_offset, clock_drift, wrong_stamps, false_blocks, duplicate_blocks, swapped_signatures. "
            "Repeatable.",
        ),
    ] = None,
    connect: options.Connect = None,
    gate: Annotated[bool, typer.Option(help="Use a gate for commands; otherwise the fake obeys ManualControl.")] = True,
    station: Station = None,
) -> None:
    """Let a fake car drive, see and send until it is interrupted; a line marks when it is ready."""
    from coopenv.base import interrupts
    from coopenv.cars.fake.fleet import prepare_fake, run
    from coopenv.cars.fake.settings import fake_fault
    from coopenv.cars.link.connect import open_transport
    from coopenv.cars.settings.deployment import load_deployment

    faults = [fake_fault(text) for text in fault or ()]
    make = prepare_fake(deployment, car, gate, station)
    with closing(open_transport(load_deployment(deployment, connect))) as transport:
        made = make(transport, seed=seed)
        for each in faults:
            made.add_fault(each)
        gc.freeze()  # what is there stays, and need not be looked through again and again
        interrupts.note(f"{car} is gone")
        print(f"{car}: fake ready", flush=True)
        run(made, threading.Event())


Speed = typer.Option(help="Largest speed, m/s [default: 0.5].", show_default=False)
Angle = typer.Option(help="Largest steering angle, rad [default: 0.5236].", show_default=False)
Acceleration = typer.Option(help="Largest acceleration and deceleration, m/s^2 [default: 1].", show_default=False)
Rate = typer.Option(help="Largest steering rate, rad/s [default: 2].", show_default=False)


@svea.command()
def gate(
    car: Annotated[str, typer.Option(help="Name of this car, as in its topics: svea7.")],
    deployment: Annotated[
        Path | None,
        typer.Argument(metavar="[DEPLOYMENT.toml]", help="Deployment with [gate], keys and limits; options win."),
    ] = None,
    connect: GateConnect = None,
    off_board: OffBoard = False,
    keys: Annotated[
        Path | None, typer.Option(help="Folder with CAR.pem and public.toml of `coopenv svea keys`.")
    ] = None,
    station: Station = None,
    max_speed: Annotated[float | None, Speed] = None,
    max_steering: Annotated[float | None, Angle] = None,
    max_acceleration: Annotated[float | None, Acceleration] = None,
    max_steering_rate: Annotated[float | None, Rate] = None,
    reverse: Annotated[bool | None, typer.Option("--reverse", help="Let the car drive backwards.")] = None,
) -> None:
    """Pass on commands that are fresh, signed, in order and inside the limits; else keep the car neutral.

    Runs on the car until it is interrupted; the car then gets neutral. It starts disarmed, and the station arms it for
    a session. It connects to the car's own router, so that neutral gets to the wheels when the radio is gone. Without a
    valid command for 0.2 s the car gets neutral until there is a newer one. A stop, from anybody, holds until the next
    arming. Clocks of car and station must agree to 50 ms (chrony). What the gate rejects is counted in its status,
    fleet/CAR/coopenv/gate.

    Limits beyond those of the make are refused: for SVEA 1.53 m/s, 0.5236 rad, 2 m/s^2 and 4 rad/s.
    """
    from coopenv.base import interrupts
    from coopenv.cars.gate.process import gate_deployment, prepare_gate, run
    from coopenv.cars.link.clock import CLOCK
    from coopenv.cars.link.connect import open_transport

    bounds = {"speed": max_speed, "steering": max_steering, "acceleration": max_acceleration}
    fleet = gate_deployment(car, deployment, connect, off_board)
    attach = prepare_gate(fleet, car, station, keys, {**bounds, "steering_rate": max_steering_rate, "reverse": reverse})
    if keys is None and fleet.keys is None:
        print("warning: without --keys whoever reaches the router can drive this car", file=sys.stderr)
    with closing(open_transport(fleet)) as transport:
        link = attach(transport, CLOCK)
        if fleet.network.kind == "zenoh":
            link.guard()
        interrupts.note(f"{car} is in neutral")
        if hasattr(signal, "SIGHUP"):  # a terminal that is closed ends the gate, too, but not before the car stands
            signal.signal(signal.SIGHUP, lambda *_: os.kill(os.getpid(), signal.SIGTERM))
        print(f"{car}: gate ready at {', '.join(fleet.network.connect)}", flush=True)
        run(link)


@svea.command()
def health(
    deployment: Fleet,
    car: CarName,
    connect: GateConnect = None,
    off_board: OffBoard = False,
    patience: Annotated[float, typer.Option(min=0.1, help="Longest wait for it, s.")] = 2.0,
    clocks: Annotated[
        float | None,
        typer.Option(min=0.0, help="s of messages for offset and drift of its clocks (default: 5 with --off-board)."),
    ] = None,
    read_only: Annotated[bool, typer.Option("--read-only", help="Send nothing, as a health check.")] = False,
) -> None:
    """Print the next status of a car's gate, and unless --read-only try from outside a neutral command to the wheels.

    The exit status is 2 where no status comes, or where the command gets through: the gate notices it and stops the
    car. On the car it connects to where the gate does, and tries from the deployment's network.connect. From elsewhere:
    --connect ROUTER --off-board.
    """
    from coopenv.base.installation import install_command, needing
    from coopenv.cars.backend.station import BYPASSED, UNTRIED, Gates, neutral_command
    from coopenv.cars.gate.gate import Reason
    from coopenv.cars.gate.process import gate_deployment
    from coopenv.cars.link.connect import open_transport
    from coopenv.cars.link.keys import load_verifier
    from coopenv.cars.link.transport import UNIX, LinkError
    from coopenv.cars.settings.deployment import load_deployment

    fleet = gate_deployment(car, deployment, connect, off_board)
    verifier = None if fleet.keys is None else load_verifier(fleet.keys)
    with closing(open_transport(fleet)) as transport:
        gates = Gates(transport, (car,), fleet.limits, None, verifier, fleet.profile)
        try:
            status = gates.fresh_states(patience)[car]
        except CoopenvError as error:
            unset = not off_board and UNIX not in fleet.gate_connect[0]
            hint = "; with docker/car-zenoh.json5 set [gate] connect" if unset else ""
            raise CoopenvError(f"{error}{hint}") from None
        refused = status.rejections.total()
        print(f"{car}: gate {status.state}, {status.accepted} commands accepted, {refused} messages refused")
        v, command = fleet.limits.speed, fleet.profile.command
        for cause, (after, way) in fleet.safety.stopping(v, command).items():
            print(
                f"{car}: {cause}: from {v:.3g} m/s to a stand {after:.2g} s and {way:.2g} m, with safety.deceleration"
            )
        if seconds := (5.0 if off_board else 0.0) if clocks is None else clocks:
            with needing(f"clocks need an extra, or --clocks 0: {install_command('svea')}"):
                from coopenv.cars.backend.assembler import arrivals_of, measured_clocks
                from coopenv.cars.backend.backend import examined_arrivals

            arrivals = arrivals_of(transport, fleet, car, seconds)
            for name, clock in measured_clocks(arrivals, fleet, car).items():
                print(f"{car}: clock of {name}: {clock}")
            for finding in examined_arrivals(arrivals, fleet) if fleet.environment else ():
                print(f"{car}: {finding}")
        if read_only:
            return
        if fleet.network.kind != "zenoh":
            print(f"{car}: network.kind = {fleet.network.kind} {UNTRIED}")
            return
        try:
            lab = load_deployment(deployment, connect if off_board else None)
            with closing(open_transport(lab, timeout=1.0)) as outside:
                outside.publish(*neutral_command(fleet.profile, car), reliable=True)
                for _ in range(2):  # the first may have been under way
                    gates.fresh_states(patience)
        except LinkError as error:
            print(f"{car}: not tried from outside: {error}")
            return
    if gates.refused(car).get(Reason.FOREIGN):
        raise CoopenvError(f"{car}: {BYPASSED}")
    print(f"{car}: a command to its wheels from outside does not get through")


@svea.command()
def see(
    deployment: Fleet,
    car: CarName,
    connect: GateConnect = None,
    off_board: OffBoard = False,
    patience: Annotated[float, typer.Option(min=0.1, help="Longest wait for the calibration of its camera, s.")] = 5.0,
) -> None:
    """Find the tags in a car's frames, the topic `detections`, and publish their bearings, until it is interrupted.

    Runs on the car, beside the gate, with its connection. Frames that come faster than they are read are left out. The
    messages of other detectors are read as well.
    """
    from coopenv.base import interrupts
    from coopenv.cars.gate.process import gate_deployment
    from coopenv.cars.link.connect import open_transport
    from coopenv.cars.messages.see import FrameReader, published_calibration
    from coopenv.cars.messages.vision import opencv

    fleet = gate_deployment(car, deployment, connect, off_board)
    if fleet.profile.sees_frames:
        opencv()
    with closing(open_transport(fleet)) as transport:
        calibration = published_calibration(car, fleet.profile, transport, patience)
        reader = FrameReader(car, fleet.profile, calibration, transport)
        interrupts.note(f"{car} sees no more")
        print(f"{car}: see ready at {', '.join(fleet.network.connect)}", flush=True)
        reader.run()


@svea.command()
def keys(
    deployment: Annotated[
        Path | None,
        typer.Argument(metavar="[DEPLOYMENT.toml]", help="Deployment: keys for its cars and its station."),
    ] = None,
    names: Annotated[str | None, typer.Option(help="Names instead, with commas between: svea7,svea8,station.")] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder of the keys (default: the deployment's security.keys, or keys).")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace existing keys.")] = False,
) -> None:
    """Make keys: NAME.pem of each car and of the station, a secret of its owner, and public.toml for all.

    Give each car its own NAME.pem and public.toml, by a trusted channel, and delete it here. Existing keys are kept.
    """
    from coopenv.cars.link.keys import PUBLIC, make_keys

    if (deployment is None) == (names is None):
        raise CoopenvError("keys: name a deployment file, or identities with --names, and not both")
    folder, wanted = out or Path("keys"), [name.strip() for name in (names or "").split(",")]
    if deployment is not None:
        from coopenv.cars.settings.deployment import load_deployment

        read = load_deployment(deployment)
        wanted = [*(car.name for car in read.cars), read.security.identity]
        folder = out or read.folder / (read.security.keys or "keys")
    new, kept = make_keys(folder, wanted, force)
    for name in new:
        print(f"{folder / f'{name}.pem'}: new, for {name} alone")
    for name in kept:
        print(f"{name}: has a key already, which is kept")
    print(f"{folder / PUBLIC}: for all")


@svea.command()
def router(
    listen: Annotated[
        list[str] | None,
        typer.Option(help="Endpoint to listen at (default: tcp/127.0.0.1:7447, this computer alone). Repeatable."),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="File of Zenoh (JSON5), e.g. docker/car-zenoh.json5. --listen replaces its endpoints."),
    ] = None,
) -> None:
    """Run a Zenoh router until it is interrupted; a line marks when it is ready."""
    from coopenv.base import interrupts
    from coopenv.cars.link.zenoh import open_zenoh

    endpoints = listen or ([] if config else ["tcp/127.0.0.1:7447"])
    with closing(open_zenoh("router", listen=endpoints, config=config)):
        interrupts.note("the router is gone")
        print(f"router ready at {', '.join(endpoints) or f'the endpoints of {config}'}", flush=True)
        threading.Event().wait()


@svea.command()
def attack(
    deployment: Annotated[Path, in_deployment(help="A fleet at a stand.")],
    commands: Annotated[int, typer.Option(min=1, help="Messages of all kinds together, at least.")] = 10_000,
    host: Annotated[
        list[str] | None, typer.Option(help="Address of a car, to scan for open ports. Repeatable.")
    ] = None,
    connect: options.Connect = None,
    seed: options.Seed = 0,
    yes: Annotated[bool, typer.Option("--yes", help="Attack real cars without a question.")] = False,
) -> None:
    """Attack a fleet at a stand as a program without keys would: nothing may move a car.

    Lists per kind of attack what was sent, what the gates refused, what got through, and the fastest car. The exit
    status is 1 where anything got through or a port is open. An armed fleet is refused. Gates are stopped afterwards
    if anything got through.
    """
    from coopenv.cars.gate.attack import Intruder, open_ports, plan, refuse_driven
    from coopenv.cars.gate.attack import attack as attacked
    from coopenv.cars.settings.deployment import load_deployment
    from coopenv.report.table import Table
    from coopenv.runs.console import Progress

    fleet, log, out = load_deployment(deployment, connect), options.console(stderr=True), options.console()
    cars = [car.name for car in fleet.cars if car.landmark is None]
    ports = [port for each in host or () for port in open_ports(each)]
    with closing(Intruder(fleet, cars, seed)) as intruder:
        refuse_driven(intruder)
        print(plan(intruder, fleet, commands), file=sys.stderr)
        if not (yes or fleet.fakes) and not (sys.stdin.isatty() and typer.confirm("Attack?", err=True)):
            raise CoopenvError("no attack on real cars without a yes (--yes)")
        table = Table.of_texts(["\nattack"], ("\nsent", "refused\nby gate", "got\nthrough", "fastest\n[m/s]"))
        sent, bad = 0, list[str]()
        with Progress(log, "attacks", len(intruder.kinds())) as progress:
            for found in attacked(intruder, commands):
                sent += found.sent
                bad += [found.what] if found.harmful else []
                speed = "?" if isnan(found.speed) else f"{found.speed:.2f}"
                cells = found.sent, found.refused, found.through, speed
                table.add(found.what, *map(str, cells))
                progress.advance()
    out.print(table)
    out.print(f"{len(bad)} of {len(table)} kinds got through, of {sent} messages: {'; '.join(bad) or 'none'}.")
    if host:
        out.print(f"Open ports: {', '.join(ports) or 'none of those that should be closed'}.")
    if bad or ports:
        raise typer.Exit(HARMED)


@dataclass(frozen=True, kw_only=True)
class SveaRunOptions:
    """Options of `coopenv svea run`."""

    config: Annotated[Path, in_deployment(help="Cars and their network.")]
    car: Annotated[
        str | None,
        typer.Option(help="Estimate and drive only this car, receive from others (default: all, as an edge server)."),
    ] = None
    arm: Annotated[bool, typer.Option("--arm", help="Arm the cars. Without it, they stand; all else runs.")] = False
    release: Annotated[
        bool, typer.Option("--release", help="With --arm: also cars stopped by another station. Find the reason first.")
    ] = False
    policy: options.PolicyName = "zero"
    seed: options.Seed = 0
    steps: Annotated[int | None, typer.Option(min=1, help="Decisions to run (default: up to the horizon).")] = None
    connect: options.Connect = None
    record: Annotated[
        Path | None, typer.Option(help="MCAP file for every message received or sent; coopenv run replays it.")
    ] = None
    out: Annotated[Path | None, typer.Option(help="Folder of the results (default: out/DEPLOYMENT).")] = None
    overrides: options.Overrides = None
    steady_from: Annotated[
        float, typer.Option(min=0.0, help="RMSE and NEES count from this time on, s: cars are localised by then.")
    ] = 2.0
    no_figures: Annotated[bool, typer.Option("--no-figures", help="Draw no figures.")] = False
    as_json: options.AsJson = False


@svea.command()
@commands.command
def run(given: SveaRunOptions) -> None:
    """Run an environment on cars: observers estimate, a policy drives, tables and figures follow.

    Without --arm no command is sent: run it beside a car with another driver.
    """
    from coopenv.base.interrupts import also_kept
    from coopenv.cars.backend.backend import open_svea
    from coopenv.cars.commands.demo import check_alive, kept_drive, links_line, links_report, truth_report
    from coopenv.runs.command import execute, report
    from coopenv.runs.rollouts import Rollout

    changes, log = options.parse_overrides(given.overrides), options.console(stderr=True)
    backend = open_svea(given.config, None, changes, given.car, given.record, connect=given.connect)
    if given.arm and backend.deployment.security.keys is None and not backend.deployment.fakes:
        print("warning: without security.keys any station on the network can drive these cars", file=sys.stderr)
    also_kept(partial(kept_drive, given.record, backend))
    wishes = {"arm": given.arm, "release": given.release}
    name, folder = given.config.stem, given.out or Path("out") / given.config.stem
    figures, watched = None if given.no_figures else "png", partial(links_line, backend)
    with closing(backend):
        rollout = Rollout(
            backend.scenario, given.seed, given.steps, policy=given.policy, backend=backend, options=wishes
        )
        alive = partial(check_alive, backend)
        result = execute(name, rollout, folder, log, changes, given.steady_from, figures, False, watched, check=alive)
    if result.metrics["without_truth"]:
        print(f"warning: {truth_report(backend)}", file=sys.stderr)
    if given.as_json:
        options.print_json({**result.metrics, "files": result.files})
    else:
        report(rollout, result, folder, options.console())
        links_report(backend, options.console())
    if backend.watchdog.trip is not None:
        raise typer.Exit(STOPPED)
