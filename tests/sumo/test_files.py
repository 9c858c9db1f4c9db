"""Content of SUMO's files, and the steps of SUMO between camera ticks; SUMO itself is not needed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import coopenv
from coopenv import ScenarioError
from coopenv.scenario import Scenario
from coopenv.sources.cosimulation import Moment
from coopenv.sumo import program as sumo
from coopenv.sumo.files import departures
from coopenv.sumo.process import SumoTraffic

NET = """<net version="1.20" {root}>
<location convBoundary="0.00,0.00,100.00,40.00"/>
<edge id="east" from="a" to="b"><lane id="east_0" index="0" shape="0,{outer} 90,{outer}"/>
<lane id="east_1" index="1" shape="0,{inner} 90,{inner}"/></edge>
<junction id="b" type="priority"/>
</net>"""

ROUTES = """<routes><trip id="a" depart="25205.00" from="east" to="east"/><trip id="t" depart="triggered"/>
<vehicle id="b" depart="7:00:30"><route edges="east"/></vehicle>
<flow id="f" begin="25300" end="26000" number="3" from="east" to="east"/></routes>"""

CONFIGURATION = """<sumoConfiguration>
<input><net-file value="nets/city.net.xml"/><route-files value="a.rou.xml, b.rou.xml"/>
<additional-files v="c.xml"/></input>
<time><begin value="7:00:00"/><end value="28800"/><step-length value="0.5"/></time>
<processing><ignore-route-errors value="true"/><time-to-teleport value="300"/></processing>
<output><tripinfo-output value="/tmp/trips.xml"/></output>
</sumoConfiguration>"""


@pytest.fixture
def city(tmp_path: Path) -> Path:
    """A folder with a configuration and its files."""
    (tmp_path / "nets").mkdir()
    (tmp_path / "nets" / "city.net.xml").write_text(NET.format(root="", outer=-4.8, inner=-1.6))
    for name, text in (("a.rou.xml", ROUTES), ("b.rou.xml", "<routes/>"), ("c.xml", "<additional/>")):
        (tmp_path / name).write_text(text)
    (tmp_path / "city.sumocfg").write_text(CONFIGURATION)
    return tmp_path


def loaded(net: Path, **section: Any) -> Scenario:
    vehicles = [{"motion": {"kind": "traffic"}, "body": {"size": [5.0, 1.8, 1.5], "center": [0.0, 0.0, 0.75]}}]
    raw = {"title": "city", "backend": "sumo", "sumo": {"net": str(net), **section}, "vehicles": vehicles}
    return coopenv.load_scenario({**raw, "horizon": 10.0, "rates": {"camera": 10.0, "odometry": 100.0}})


@pytest.mark.filterwarnings("ignore::coopenv.base.errors.ScenarioWarning")
@pytest.mark.parametrize(
    ("root", "outer", "inner", "beside"), [("", -4.8, -1.6, -6.9), ('lefthand="true"', 4.8, 1.6, 6.9)]
)
def test_posts_stand_beside_the_road_on_the_side_of_the_traffic(
    root: str, outer: float, inner: float, beside: float, tmp_path: Path
) -> None:
    """1.6 m from the middle of the outer lane to its edge, and 0.5 m more."""
    path = tmp_path / "net.xml"
    path.write_text(NET.format(root=root, outer=outer, inner=inner))
    (post,) = loaded(path).landmarks
    assert post.position == pytest.approx((90.0, beside, 3.0))


@pytest.mark.filterwarnings("ignore::coopenv.base.errors.ScenarioWarning")
def test_a_configuration_stands_for_its_files(city: Path) -> None:
    """Paths are relative to it, and nothing of it that SUMO would write to is taken; keys of the section come first."""
    section = loaded(city / "city.sumocfg").sumo
    assert section is not None and section.net == str(city / "nets" / "city.net.xml")
    assert section.routes == (str(city / "a.rou.xml"), str(city / "b.rou.xml"))
    assert section.additional == (str(city / "c.xml"),) and section.begin == 25200.0
    assert section.options == {"ignore-route-errors": "true"}
    own = loaded(city / "city.sumocfg", begin=5.0, routes=[], options={"ignore-route-errors": False}).sumo
    assert own is not None and (own.begin, own.routes, own.options) == (5.0, (), {"ignore-route-errors": False})
    assert loaded(city / "city.sumocfg").model_dump() == loaded(city / "city.sumocfg").model_dump()


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("<configuration/>", r"sumo\.net: city\.sumocfg: it names no network \(net-file\)"),
        ('<c><i><net-file value="city.sumocfg"/></i></c>', "it names no network"),
        ('<c><i><net-file value="no.net.xml"/></i></c>', r"sumo\.net: '.*no\.net\.xml': No such file"),
        ('<c><i><net-file value="n"/><begin value="dawn"/></i></c>', r"city\.sumocfg: .*could not convert"),
        ('<c><i><net-file value="n"/><begin value="-1"/></i></c>', "'-1' is no time"),
        (f"<c>{' ' * 2**20}</c>", r"sumo\.net: '.*city\.sumocfg': more than 1 MiB, so it is no configuration"),
        ("<c><i>", r"sumo\.net: city\.sumocfg: not XML"),
    ],
)
def test_a_configuration_that_is_none_is_one_line(text: str, why: str, city: Path) -> None:
    (city / "city.sumocfg").write_text(text)
    with pytest.raises(ScenarioError, match=why) as caught:
        loaded(city / "city.sumocfg")
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore::coopenv.base.errors.ScenarioWarning")
def test_departures_after_the_begin_are_named(city: Path) -> None:
    section = loaded(city / "city.sumocfg").sumo
    assert section is not None
    named = "; the first of 3 departs at 25,205 s, the last at 25,300 s"
    assert departures(section) == named
    late = loaded(city / "city.sumocfg", begin=0.0).sumo
    assert late is not None
    assert departures(late) == f"{named}: sumo.begin = 25205, or sumo.warm_up = 25265"
    assert departures(late.model_copy(update={"routes": ()})) == ""


@pytest.mark.parametrize(
    ("rate", "step", "most"), [(10.0, 100, 1), (30.0, 33, 2), (60.0, 16, 2), (29.97, 33, 2), (1e3, 1, 1)]
)
def test_ticks_lie_within_the_last_step(rate: float, step: int, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """SUMO's steps are whole milliseconds. A driven vehicle is where it is at the end of each of them."""
    monkeypatch.setattr(sumo, "find_spec", lambda name: True)
    program = sumo.SumoProgram(coopenv.load_scenario("sumo_crossing", {"rates.camera": rate, "rates.decision": rate}))
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(program, "_ask", asked.append)
    monkeypatch.setattr(program, "_process", object())
    assert f"--step-length={step / 1000}" in program._request["arguments"]
    count, time, speed = len(program._taken), 0.0, 7.0
    (i, *_) = np.flatnonzero(program._taken)
    for tick in range(250):
        xy = np.tile([speed * tick / rate, 0.0], (count, 1))
        zeros = np.zeros(count)
        program.command(Moment(np.zeros((count, 4)), zeros == 0.0, xy, zeros, zeros + speed, zeros))
        moves, share = asked[-1]["moves"], asked[-1]["share"]
        assert (1 if tick else 0) <= len(moves) <= most and 0.0 < share <= 1.0
        for rows in moves:
            time += step / 1000.0
            (place,) = [row[1] for row in rows if row[0] == i]
            front = program._origin[0] + program._front[i]
            assert place == pytest.approx(front + speed * time, abs=1e-6)
        assert time + (share - 1.0) * step / 1000.0 == pytest.approx((tick + 1) / rate, abs=1e-9)
        assert program._ticks == tick + 1


def test_places_between_two_steps() -> None:
    traffic = object.__new__(SumoTraffic)
    traffic.before, traffic.now = {"a": (0.0, 10.0, 350.0)}, {"a": (4.0, 10.0, 10.0), "new": (1.0, 2.0, 3.0)}
    assert traffic.place("a", 0.25) == (1.0, 10.0, -5.0)  # 355 deg
    assert traffic.place("a", 1.0) == (4.0, 10.0, 10.0) and traffic.place("new", 0.25) == (1.0, 2.0, 3.0)
