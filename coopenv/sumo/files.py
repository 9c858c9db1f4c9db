"""Content of SUMO's files: configurations, networks, routes, and what stands beside the roads.

Formats: https://sumo.dlr.de/docs/Networks/SUMO_Road_Networks.html and
https://sumo.dlr.de/docs/Simulation/Shapes.html. Coordinates are SUMO's, m; heights are not read.
"""

import gzip
import json
import math
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from errno import EFBIG
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, ParseError, iterparse

import numpy as np

from coopenv.base.errors import ScenarioError, regular, shown
from coopenv.base.sections import parsed
from coopenv.scenario.cosimulators import Sumo

LANE_WIDTH = 3.2
"""m, of lanes that state none."""
SIDE = 0.5
"""Distance (m) from the edge of a road to the post beside it."""
WALL = 0.1
"""m, thickness of the walls of a building that is no rectangle."""
RECTANGULAR = 0.99
"""Share of the rectangle about a polygon that it fills at least to be one building."""

CONFIGURATIONS = (".sumocfg", ".cfg")
MOST_CONFIGURATION = 2**20  # bytes
CONFIGURED_FILES = {"net": "net-file", "routes": "route-files", "additional": "additional-files"}
"""Keys of a section, and SUMO's names of them in a configuration, whose paths are relative to it."""

Shape = np.ndarray
"""(K, 2) m."""


@dataclass
class SumoNetwork:
    """Content of a network file that a scenario uses."""

    center: tuple[float, float] = (0.0, 0.0)
    left_hand: bool = False
    """True if traffic keeps to the left."""
    lanes: dict[str, list[tuple[Shape, float]]] = field(default_factory=dict)
    """Middle and width (m) of the lanes of every edge, from the outer one inwards."""
    inner: dict[str, Shape] = field(default_factory=dict)
    """Middle of every lane within a junction, by its id."""
    goes_to: dict[str, str] = field(default_factory=dict)
    """Edge to the junction at its end."""
    turns: dict[tuple[str, str], list[tuple[int, int, str]]] = field(default_factory=dict)
    """Edges to connections of their lanes: indices of both lanes, and the lane within the junction."""
    dead_ends: set[str] = field(default_factory=set)
    """Junctions where a road ends."""


def with_sumo(raw: Any) -> Any:
    """Return the plain data of a scenario with what the files of its section `[sumo]` hold.

    What is not as it should be is left for the schema to complain about.

    Raises:
        ScenarioError: a file cannot be read.
    """
    section = raw.get("sumo") if isinstance(raw, Mapping) else None
    if section is None or raw.get("backend") != "sumo":
        return raw
    try:
        made = parsed(Sumo, json.dumps(section))
    except (TypeError, ValueError):
        return raw
    if made.net.endswith(CONFIGURATIONS):
        return with_sumo({**raw, "sumo": _with_configuration(section)})
    lists = [raw.get(key, []) for key in ("landmarks", "obstacles", "routes", "vehicles", "roads")]
    if (made.included and "landmarks" in raw) or not all(isinstance(given, list) for given in lists):
        return raw
    landmarks, obstacles, routes, vehicles, roads = lists
    network = _read_network(made)
    marks, buildings = _shapes(made)
    wanted = {name for v in vehicles if isinstance(v, Mapping) for name in _names(v.get("routes"))}
    wanted -= {route.get("name") for route in routes if isinstance(route, Mapping)}
    edges = route_edges(made) if wanted else {}
    with _reading(Path(made.net), "sumo.net"):
        ways = [_route(network, name, edges[name]) for name in sorted(wanted & edges.keys())]
    return {
        **raw,
        "map": raw.get("map", {"origin": [*network.center, 0.0]}),
        "roads": roads or list(_roads(network)),
        "landmarks": [*landmarks, *(_posts(network, made.post_height) if made.posts else ()), *marks],
        "obstacles": [*obstacles, *buildings],
        "routes": [*routes, *ways],
        "sumo": {**section, "included": True},
    }


def _with_configuration(section: Mapping[str, Any]) -> dict[str, Any]:
    """Return a section with the content of the configuration that it names as network; its other keys come first.

    Outputs, windows, seed, step length and end of a configuration do not concern an episode.
    """
    path, given, found = Path(section["net"]), dict[str, str](), dict[str, Any]()
    with _reading(path, "sumo.net"):
        if path.stat().st_size > MOST_CONFIGURATION:
            raise OSError(EFBIG, f"more than {MOST_CONFIGURATION // 2**20} MiB, so it is no configuration")
        for part in _elements(path):
            given |= {option.tag: option.get("value", option.get("v", "")) for option in part.iter()}
        for key, name in CONFIGURED_FILES.items():
            found[key] = [str(path.parent / file.strip()) for file in given.get(name, "").split(",") if file.strip()]
        if not found["net"] or found["net"][0].endswith(CONFIGURATIONS):
            raise ScenarioError(f"sumo.net: {path.name}: it names no network (net-file)")
        found |= {"begin": _seconds(given["begin"])} if "begin" in given else {}
    options = {name: given[name] for name in Sumo.traffic_options if name in given} | section.get("options", {})
    return {**found, **section, "net": found["net"][0], "options": options}


def _seconds(text: str) -> float:
    """Return a time of SUMO, s: a number, or (days,) hours, minutes, seconds. Raises ValueError: it is neither."""
    units = (1.0, 60.0, 3600.0, 86400.0)
    found = sum(float(part) * unit for part, unit in zip(reversed(text.split(":")), units, strict=False))
    if not 0.0 <= found < math.inf:
        raise ValueError(f"{shown(text)} is no time")
    return found


def departures(section: Sumo) -> str:
    """Return when the vehicles and flows of a section's files depart, for an error about too few of them.

    Raises:
        ScenarioError: a file cannot be read.
    """
    times = []
    for element in _route_elements(section):
        if element.tag in ("vehicle", "trip", "flow"):
            with suppress(ValueError):  # words, such as `triggered`
                times.append(_seconds(element.get("depart", element.get("begin", "0"))))
    if not times:
        return ""
    first, last, begin = min(times), max(times), math.floor(min(times))
    late = first > section.begin + section.warm_up
    mended = f": sumo.begin = {begin}, or sumo.warm_up = {begin + 60}" if late else ""
    return f"; the first of {len(times):,} departs at {first:,.10g} s, the last at {last:,.10g} s{mended}"


def _names(given: Any) -> list[str]:
    return [name for name in given if isinstance(name, str)] if isinstance(given, list) else []


def _read_network(section: Sumo) -> SumoNetwork:
    """Return the network of a section. Raises ScenarioError: it cannot be read."""
    path = Path(section.net)
    with _reading(path, "sumo.net"):
        found = _network(path, path.stat().st_mtime_ns)
    if not found.lanes:
        raise ScenarioError(f"sumo.net: {path.name}: no roads in it; expected a network of netconvert or netgenerate")
    return found


@lru_cache(maxsize=8)
def _network(path: Path, modified: int) -> SumoNetwork:
    found = SumoNetwork()
    for element in _elements(path):
        if element.tag == "net":
            found.left_hand = element.get("lefthand") in ("true", "1")
        elif element.tag == "location":
            left, bottom, right, top = map(float, element.attrib["convBoundary"].split(","))
            found.center = (round((left + right) / 2, 2), round((bottom + top) / 2, 2))
        elif element.tag == "edge":
            lanes = [(_shape(x.attrib["shape"]), float(x.get("width", LANE_WIDTH))) for x in element.iter("lane")]
            if element.get("function") == "internal":
                found.inner.update({x.attrib["id"]: s for x, (s, _) in zip(element.iter("lane"), lanes, strict=True)})
            elif element.get("function", "normal") == "normal":
                if min((len(shape) for shape, _ in lanes), default=0) < 2:
                    raise ValueError(f"edge {shown(element.attrib['id'])} needs lanes of two points or more")
                found.lanes[element.attrib["id"]] = lanes
                found.goes_to[element.attrib["id"]] = element.attrib["to"]
        elif element.tag == "junction" and element.get("type") == "dead_end":
            found.dead_ends.add(element.attrib["id"])
        elif element.tag == "connection":
            turn = int(element.attrib["fromLane"]), int(element.attrib["toLane"]), element.get("via", "")
            found.turns.setdefault((element.attrib["from"], element.attrib["to"]), []).append(turn)
    return found


MOST_BYTES, LEAST_BYTES, MOST_UNPACKED = 2**30, 2**25, 50
"""Limits of the XML of a network or of routes, unpacked: of every file, and of a small one with its size's factor."""
MOST_PARTS = 100_000
"""Parts of one element below the root."""


class _LimitedReader:
    """Reads a file up to a limit."""

    def __init__(self, file: Any, size: int) -> None:
        self._file, self.most = file, min(MOST_BYTES, LEAST_BYTES + MOST_UNPACKED * size)
        self._left = self.most

    def read(self, size: int = -1) -> bytes:
        """Return bytes of the file. Raises OSError: it has more than the limit."""
        data: bytes = self._file.read(size)
        self._left -= len(data)
        if self._left < 0:
            raise OSError(EFBIG, f"more than {self.most // 2**20} MiB of XML")
        return data


def _elements(path: Path) -> Iterator[Element]:
    """Yield the root of a file, plain or .gz, without its content, and then the elements below it."""
    path, depth, parts = regular(path), 0, 0
    with gzip.open(path) if path.suffix == ".gz" else path.open("rb") as file:
        for event, element in iterparse(_LimitedReader(file, path.stat().st_size), events=("start", "end")):
            depth, parts = (depth + 1, parts + 1) if event == "start" else (depth - 1, parts)
            if depth == 1 and event == "start":
                root = element
                yield Element(element.tag, element.attrib)
            if parts > MOST_PARTS:
                raise OSError(EFBIG, f"an element with more than {MOST_PARTS:,} parts")
            if depth == 1 and event == "end":
                yield element
                root.clear()
                parts = 0


@contextmanager
def _reading(path: Path, key: str) -> Iterator[None]:
    """Turn an error of a file into a `ScenarioError` that names the key and the file."""
    try:
        yield
    except OSError as error:
        raise ScenarioError(f"{key}: {shown(str(path))}: {error.strerror or error}") from None
    except (ParseError, EOFError, zlib.error) as error:
        raise ScenarioError(f"{key}: {path.name}: not XML: {error}") from None
    except ScenarioError:
        raise
    except (KeyError, ValueError, IndexError) as error:
        raise ScenarioError(f"{key}: {path.name}: an element lacks or spoils an attribute: {error}") from None


def _shape(text: str) -> Shape:
    """Return the points of a text, without those that repeat the one before."""
    points = np.array([[float(x) for x in point.split(",")[:2]] for point in text.split()]).reshape(-1, 2)
    kept: Shape = points[np.append(True, np.diff(points, axis=0).any(axis=1))[: len(points)]]
    return kept


def _roads(network: SumoNetwork) -> Iterator[dict[str, Any]]:
    for lanes in network.lanes.values():
        for shape, width in lanes:
            for a, b in pairwise(shape.tolist()):
                yield {"start": a, "end": b, "width": width, "marked": False}


def _posts(network: SumoNetwork, height: float) -> Iterator[dict[str, Any]]:
    """Yield a landmark beside every stop line, on the side of its traffic."""
    into = [edge for edge, junction in network.goes_to.items() if junction not in network.dead_ends]
    for k, edge in enumerate(into):
        shape, width = network.lanes[edge][0]
        ahead = shape[-1] - shape[-2]
        right = np.array([ahead[1], -ahead[0]]) / math.hypot(*ahead)
        place = shape[-1] + (-right if network.left_hand else right) * (width / 2 + SIDE)
        yield {"name": f"post_{k + 1}", "position": [*place.round(3).tolist(), height]}


def _shapes(section: Sumo) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Return the landmarks and the obstacles of the additional files."""
    marks: list[dict[str, Any]] = []
    buildings: list[dict[str, Any]] = []
    for name in section.additional:
        with _reading(Path(name), "sumo.additional"):
            for element in _elements(Path(name)):
                kind, low = element.get("type", ""), section.post_height
                height = {p.get("key"): p.get("value", "") for p in element.iter("param")}.get("height")
                if element.tag == "poi" and kind.startswith(section.landmarks):
                    place = [float(element.attrib["x"]), float(element.attrib["y"]), float(height or low)]
                    marks.append({"name": f"poi_{len(marks) + 1}", "position": place})
                elif element.tag == "poly" and kind.startswith(section.buildings):
                    tall = float(height or section.building_height)
                    buildings += _building(f"{element.attrib['id']}"[:50], _shape(element.attrib["shape"]), tall)
    return marks, buildings


def _building(name: str, outline: Shape, height: float) -> list[dict[str, Any]]:
    """Return the box of a rectangle, or the walls of another polygon."""
    closed = np.vstack([outline, outline[:1]])
    walls = [(a, b) for a, b in pairwise(closed) if not np.array_equal(a, b)]
    if len(walls) < 3:
        return []
    a, b = max(walls, key=lambda wall: math.dist(*wall))
    along = (b - a) / math.dist(a, b)
    axes = np.array([along, [-along[1], along[0]]])
    low, high = (outline @ axes.T).min(axis=0), (outline @ axes.T).max(axis=0)
    area = abs(sum(p[0] * q[1] - p[1] * q[0] for p, q in walls)) / 2
    if area >= RECTANGULAR * np.prod(high - low):
        return [_box(name, (low + high) / 2 @ axes, high - low, along, height)]
    return [
        _box(f"{name}_wall_{k + 1}", (p + q) / 2, (math.dist(p, q), WALL), q - p, height)
        for k, (p, q) in enumerate(walls)
    ]


def _box(name: str, center: Any, size: Any, along: Any, height: float) -> dict[str, Any]:
    return {
        "name": name,
        "center": [*np.round(center, 3).tolist(), height / 2],
        "size": [*np.round(size, 3).tolist(), height],
        "yaw": math.atan2(along[1], along[0]),
    }


def route_edges(section: Sumo) -> dict[str, list[str]]:
    """Return the edges of the routes of a section's files, by the id of the route, or of the vehicle that has it.

    Raises:
        ScenarioError: a file cannot be read.
    """
    found = {}
    for element in _route_elements(section):
        route = element if element.tag == "route" else element.find("route")
        if route is not None and "edges" in route.attrib:
            found[element.get("id", "")] = route.attrib["edges"].split()
    return found


def _route_elements(section: Sumo) -> Iterator[Element]:
    """Yield the elements of the files that may hold routes."""
    for key in ("routes", "additional"):
        for name in getattr(section, key):
            with _reading(Path(name), f"sumo.{key}"):
                yield from _elements(Path(name))


def _route(network: SumoNetwork, name: str, edges: Sequence[str]) -> dict[str, Any]:
    """Return a route along the middle of lanes, from the outermost one on. Raises ScenarioError: no such way."""
    if lost := [edge for edge in edges if edge not in network.lanes]:
        raise ScenarioError(f"sumo.routes: route {shown(name)}: the network has no edge {shown(lost[0])}")
    lane, parts = 0, []
    for here, there in pairwise([*edges, ""]):
        turns = network.turns.get((here, there), []) if there else [(lane, 0, "")]
        if not turns:
            raise ScenarioError(f"sumo.routes: route {shown(name)}: no way from edge {shown(here)} to {shown(there)}")
        start, end, via = min(turns, key=lambda turn: abs(turn[0] - lane))
        parts += [network.lanes[here][start][0]]
        passed: dict[str, Shape] = {}
        while via:
            if via in passed:
                raise ValueError(f"lane {shown(via)} leads to itself")
            passed[via] = network.inner[via]
            via = next((v for _, _, v in network.turns.get((via.rpartition("_")[0], there), ())), "")
        parts += passed.values()
        lane = end
    points = np.concatenate(parts).round(2)
    apart = np.hypot(*np.diff(points, axis=0).T) > 0.1
    return {"name": name, "waypoints": points[np.append(True, apart)].tolist()}
