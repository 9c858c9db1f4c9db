"""The import and the help load neither the simulation nor what only results need."""

from __future__ import annotations

import codecs
import json
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import coopenv
import coopenv.observers
import coopenv.runs
from coopenv.base.errors import escaped, printable
from coopenv.cli import arguments
from tests.helpers.four_way import FOUR_WAY

HEAVY = {"warp", "scipy", "numba", "matplotlib", "PIL", "pandas", "mcap", "torch", "joblib", "jinja2"}
LIGHT = {f"base.{name}" for name in ("errors", "installation", "interrupts", "plugins", "seeds")}
LIGHT |= {"base", "api", "api.registration"}
PACKAGE = Path(coopenv.__file__).parent
LIGHT |= {"cli", *(f"cli.{path.stem}" for path in (PACKAGE / "cli").glob("[a-z]*.py"))}
COMMANDS = {"cars", "cars.commands", *(f"cars.commands.{name}" for name in ("bags", "svea"))}
"""Modules of a guest that its commands need; only the help of all commands and their own run load them."""


def modules_after(statement: str) -> set[str]:
    """Return the names of the modules that a fresh interpreter holds after the statement."""
    code = f"import sys\n{statement}\nprint('MODULES', *sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(result.stdout.rpartition("MODULES ")[2].split())


@pytest.mark.parametrize(
    "statement", ["import coopenv", "from coopenv.cli.app import main; main(['--version']); main(['frobnicate'])"]
)
def test_start_loads_no_simulation(statement: str) -> None:
    loaded = modules_after(statement)
    assert "coopenv.base.errors" in loaded
    assert not HEAVY & {name.partition(".")[0] for name in loaded}
    own = {name.removeprefix("coopenv.") for name in loaded if name.startswith("coopenv.")}
    assert own <= LIGHT


HELP = """
sys.orig_argv[1:3] = ['-m', 'coopenv']  # so that nothing is registered with Gymnasium
import contextlib, io
from coopenv.cli.app import app, main
from typer.main import get_command

def help_of(command, path):
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main([*path, "--help"]) == 0
    assert "Usage:" in printed.getvalue(), path
    below = getattr(command, "commands", {})
    assert not below or "..." not in printed.getvalue().partition("Options:")[2], path  # no sentence is cut
    return 1 + sum(help_of(one, [*path, name]) for name, one in below.items())

assert help_of(get_command(app), []) > 30
"""


def test_the_help_of_every_command_loads_nothing_heavy_and_is_whole() -> None:
    loaded = modules_after(HELP)
    assert not (HEAVY | {"numpy", "rich"}) & {name.partition(".")[0] for name in loaded}
    assert {name.removeprefix("coopenv.") for name in loaded if name.startswith("coopenv.")} <= LIGHT | COMMANDS


FORKED = """
import json, os, sys
sys.orig_argv[1:3] = ["-m", "coopenv"]  # so that nothing is registered with Gymnasium
from coopenv.cli.app import main
first, *others = json.loads(sys.argv[1])
with open(os.devnull, "w") as sys.stdout, open(os.devnull, "w") as sys.stderr:
    main(first.split())  # loads what the others need as well
for command in (first, *others):
    if os.fork() == 0:
        with open(os.devnull, "w") as sys.stdout, open(os.devnull, "w") as sys.stderr:
            status = main(command.split())
        loaded = {name.partition(".")[0] for name in sys.modules}
        print(json.dumps([command, status, sorted(loaded)]), file=sys.__stdout__, flush=True)
        os._exit(0)
    os.wait()
"""
LOOKING = ["list", "list observers", "list agents", "list scenes", "list variants", "describe facade"]
LOOKING += ["describe busy_intersection --json", "describe large_crossing --all"]
WRONG = {
    "run nosuch": {"numpy"},
    "run tre:5": {"numpy"},
    "run lane:x": set(),
    "run facade --policy nosuch": set(),
    "run facade --set noise.enabledd=false": set(),
    "record facade --out x.mcap --observer nosuch": {"numpy"},
    "view nosuch": {"numpy"},
    "film nosuch --out x.mp4": {"numpy"},
    "train nosuch": {"numpy"},
    "watch nosuch": set(),
    "evaluate facade --agents peek,nosuch": set(),
    "bench observers facade --observers riccati,nosuch": {"numpy"},
    "bench observers facade --observers nosuch.py:Mine": set(),
    "bench observers nosuch.bag": {"numpy"},
    "bench v1 examples/own_observer.py:Eky": set(),
    "evaluate facade --agents nosuch.py:Mine": set(),
    "train facade --set nosuch=3": set(),
    "train facade --agent nosuch": set(),
    "run nosuch.mcap": {"numpy"},
    "export nosuch": {"numpy"},
    "calibrate nosuch": {"numpy"},
    "svea run nosuch.toml": {"numpy"},
}
"""Command with a name that there is not, and what it does not load besides."""


@pytest.fixture(scope="module")
def ended() -> dict[str, tuple[int, list[str]]]:
    """Return the status of commands, each in a fork of an interpreter, and the packages that both have loaded."""
    found = {}
    for orders in ([c for c in WRONG if WRONG[c]], ["describe facade", *LOOKING, *(c for c in WRONG if not WRONG[c])]):
        program = [sys.executable, "-c", FORKED, json.dumps(orders)]
        lines = subprocess.run(program, stdout=subprocess.PIPE, text=True, check=True).stdout.splitlines()
        found |= {command: (status, loaded) for command, status, loaded in map(json.loads, lines)}
    return found


@pytest.mark.parametrize("command", LOOKING)
def test_looking_around_loads_no_simulation(command: str, ended: dict[str, tuple[int, list[str]]]) -> None:
    status, loaded = ended[command]
    assert status == 0 and not (HEAVY | {"gymnasium", "pettingzoo"}) & {*loaded}


@pytest.mark.parametrize("command", WRONG)
def test_a_wrong_name_is_refused_before_anything_is_loaded(
    command: str, ended: dict[str, tuple[int, list[str]]]
) -> None:
    status, loaded = ended[command]
    assert status == 2 and not (HEAVY | {"gymnasium", "pettingzoo"} | WRONG[command]) & {*loaded}


def test_a_city_is_checked_in_few_calls() -> None:
    """By the number of functions that are called for its 392 routes and 100 vehicles, which no load changes."""
    calls = 0

    def count(frame: object, event: str, argument: object) -> None:
        nonlocal calls
        calls += event in ("call", "c_call")

    coopenv.load_scenario("city")
    sys.setprofile(count)
    try:
        coopenv.load_scenario("city")
    finally:
        sys.setprofile(None)
    assert calls < 130_000


def test_make_finds_environments_after_the_import_alone() -> None:
    loaded = modules_after(
        "import coopenv, gymnasium\nassert gymnasium.make('coopenv/UrbanCrossing-v0').unwrapped.reset(seed=0)"
    )
    assert "warp" in loaded


@pytest.mark.parametrize("package", [coopenv, coopenv.observers, coopenv.runs], ids=lambda package: package.__name__)
def test_every_public_name_is_found_and_listed(package: ModuleType) -> None:
    assert all(getattr(package, name) is not None for name in package.__all__)
    assert dir(package) == sorted(package.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        package.nothing  # noqa: B018


def test_the_shell_completes_without_the_simulation() -> None:
    loaded = modules_after("from coopenv.cli.arguments import *; environments(''), agents(''), policies('')")
    assert not {name for name in loaded if name.startswith("coopenv.")} - {f"coopenv.{name}" for name in LIGHT}
    assert not HEAVY & modules_after("from coopenv.cli.arguments import *; observers('')")
    assert not HEAVY & modules_after("from coopenv.cli.arguments import *; override_keys('')")


def test_completions() -> None:
    assert arguments.environments("busy") == [name for name in coopenv.list_envs() if name.startswith("busy")]
    assert arguments.agents("route") == ["route_follower"]
    assert arguments.agent_lists("mine.py:Mine,route") == ["mine.py:Mine,route_follower"]
    assert arguments.policies("") == ["zero", "random", *arguments.agents("")]
    assert arguments.observers("riccati,mek") == [
        "riccati,mekf",
        "riccati,mekf_covariance",
        "riccati,mekf_covariance_ungated",
    ]
    assert "mekf" not in arguments.observers("mekf,me")
    assert arguments.override_keys("noise.e") == ["noise.enabled="]
    assert arguments.override_keys("vehicles.*.goal") == ["vehicles.*.goal.position=", "vehicles.*.goal.radius="]


def test_every_completed_key_is_one_that_the_loader_knows() -> None:
    keys = [key.removesuffix("=") for key in arguments.override_keys("") if "*" not in key]
    assert len(keys) > 50
    for key in keys:
        try:
            coopenv.load_scenario(FOUR_WAY, {key: {"no": "such value"}})
        except coopenv.ScenarioError as error:
            assert "unknown" not in str(error), key


def test_completion_is_offered_by_the_program() -> None:
    asked = {"_COOPENV_COMPLETE": "complete_bash", "COMP_WORDS": "coopenv run cross", "COMP_CWORD": "2"}
    command = [sys.executable, "-c", "from coopenv.cli.app import app; app(prog_name='coopenv')"]
    result = subprocess.run(command, env={**os.environ, **asked}, capture_output=True, text=True, check=False)
    assert result.stdout.split() == ["crossing_path", "crossroad:"]


def test_a_name_that_the_locale_cannot_decode_is_printed_as_its_characters() -> None:
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    command = [sys.executable, "-m", "coopenv", "run", "é/x.toml".encode()]
    result = subprocess.run(command, env={**os.environ, **locale}, capture_output=True, check=False)
    assert result.stderr == b"error: no such scenario file: \\xe9/x.toml\n"
    assert printable("\udcc3\udca9 \udcff \ud800 \x1b") == r"é \udcff \ud800 \x1b"
    codecs.register_error("escaped", escaped)
    assert "\udcc3\udca9 σ \udcff".encode("ascii", "escaped") == rb"\xe9 \u03c3 \udcff"
