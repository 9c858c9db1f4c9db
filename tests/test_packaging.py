"""The wheel works away from the checkout, and the base install stays small."""

from __future__ import annotations

import os
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = {"torch", "ray", "highway-env", "stable-baselines3", "jax"}

pytestmark = pytest.mark.packaging


def run(*command: str | Path, cwd: Path) -> str:
    environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    result = subprocess.run([str(c) for c in command], cwd=cwd, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", out, ROOT, cwd=out)
    (built,) = out.glob("*.whl")
    return built


def test_wheel_contents(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    shipped = {Path(n).name for n in names if n.startswith("coopenv/data/envs/")}
    assert shipped == {path.name for path in (ROOT / "envs").glob("*.toml")}
    agents = {Path(n).parts[3] for n in names if n.startswith("coopenv/data/agents/") and len(Path(n).parts) > 4}
    assert agents == {path.name for path in (ROOT / "agents").iterdir() if path.is_dir()}
    assert {"overtaking.toml", "crossing.toml"} <= {Path(n).name for n in names if "data/examples/fleet/" in n}
    tops = {Path(n).parts[0] for n in names}
    assert {t for t in tops if not t.endswith(".dist-info")} == {"coopenv"}
    assert "coopenv/py.typed" in names


def test_the_source_distribution_is_the_repository(tmp_path: Path) -> None:
    if not (ROOT / ".git").exists():
        pytest.skip("what belongs to the repository is known to git alone")
    run(sys.executable, "-m", "build", "--sdist", "--no-isolation", "--outdir", tmp_path, ROOT, cwd=tmp_path)
    (built,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    tracked = {name for name in run("git", "ls-files", cwd=ROOT).splitlines() if (ROOT / name).exists()}
    assert tracked - names == set()
    assert {name.partition("/")[0] for name in names - tracked} <= {"PKG-INFO", *(n.partition("/")[0] for n in tracked)}


@pytest.mark.slow
def test_installed_wheel_makes_environments(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "--constraint", ROOT / "constraints.txt", wheel, cwd=tmp_path)
    listed = run(python, "-m", "pip", "list", "--format=freeze", cwd=tmp_path)
    assert not {line.split("==")[0].lower() for line in listed.splitlines()} & HEAVY
    script = (
        "import coopenv, pathlib, gymnasium;"
        f"assert not pathlib.Path(coopenv.__file__).is_relative_to({str(ROOT)!r});"
        "env = coopenv.parallel_env('busy_intersection'); env.reset(seed=0);"
        "print(*coopenv.list_envs(), len(env.step({a: env.action_space(a).sample() for a in env.agents})))"
    )
    printed = run(python, "-c", script, cwd=tmp_path).split()
    assert printed[:-1] == sorted(path.stem for path in (ROOT / "envs").glob("*.toml"))
    assert printed[-1] == "5"
    assert "busy_intersection" in run(tmp_path / "venv" / "bin" / "coopenv", "list", cwd=tmp_path)
