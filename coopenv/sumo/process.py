"""SUMO in a process of its own, which `coopenv.sumo.program` starts and talks to through pipes.

Every request is a line of JSON on the standard input. Every reply is a line of JSON with the numbers of rows, and then
the rows as 64-bit floats; or a line with the key `error`. SUMO's own server (TraCI) listens on all interfaces of a
machine, so it is not used: this file imports the library. It imports nothing of coopenv.
"""

import json
import os
import signal
import sys
from array import array
from typing import Any

Rows = tuple["array[float]", "array[float]"]
Place = tuple[float, float, float]  # x, y (m) and angle (deg)
NAN = float("nan")


class SumoTraffic:
    """One simulation, and the vehicles of a scenario in it."""

    def __init__(self) -> None:
        import libsumo

        self.sumo: Any = libsumo
        self.begun = False
        self.names: list[str | None] = []
        self.sizes: dict[str, tuple[float, float, float]] = {}
        self.before, self.now = dict[str, Place](), dict[str, Place]()  # before and after the last step

    def reset(
        self,
        arguments: list[str],
        until: float,
        vehicles: list[dict[str, Any] | None],
        center: tuple[float, float],
        wait: float,
    ) -> Rows:
        """Load the network and let traffic drive until a time, s; then put the vehicles with a route on it.

        `vehicles` have a `route` (edges), a `size` (m) and a `speed` (m/s at most), or nothing: those are then the
        vehicles of the traffic that are nearest to `center` (m) and not parked. The routes are tried for `wait` s.
        """
        sumo = self.sumo
        if self.begun:
            sumo.load(arguments)
        else:
            sumo.start(["sumo", *arguments])
        self.begun, self.sizes = True, {}
        if until > sumo.simulation.getTime():
            sumo.simulationStep(until)
        self.names = [f"coopenv_{i}" if vehicle else None for i, vehicle in enumerate(vehicles)]
        for name, vehicle in zip(self.names, vehicles, strict=True):
            if name and vehicle:
                self.add(name, **vehicle)
        own = [name for name in self.names if name]
        latest = sumo.simulation.getTime() + wait
        while missing := [name for name in own if name not in sumo.vehicle.getIDList()]:
            if sumo.simulation.getTime() > latest:
                i = self.names.index(missing[0])
                raise ValueError(f"vehicles.{i}.routes: no room at the start of its route for {wait:g} s")
            sumo.simulationStep()
        x, y = center
        under_way = [n for n in sumo.vehicle.getIDList() if n not in own and not sumo.vehicle.isStoppedParking(n)]
        places = {name: sumo.vehicle.getPosition(name) for name in under_way}
        nearest = sorted(places, key=lambda name: ((places[name][0] - x) ** 2 + (places[name][1] - y) ** 2, name))
        wanted = self.names.count(None)
        if len(nearest) < wanted:
            raise ValueError(f"vehicles: {wanted} are in traffic, but SUMO has {len(nearest)} after sumo.warm_up")
        others = iter(nearest)
        self.names = [name or next(others) for name in self.names]
        self.now = self.places()
        return self.rows(1.0)

    def add(self, name: str, route: list[str], size: tuple[float, float, float], speed: float) -> None:
        """Add a vehicle that drives off at the next step where there is room."""
        sumo = self.sumo
        sumo.route.add(name, route)
        sumo.vehicletype.copy("DEFAULT_VEHTYPE", name)
        length, width, height = size
        sumo.vehicletype.setLength(name, length)
        sumo.vehicletype.setWidth(name, width)
        sumo.vehicletype.setHeight(name, height)
        sumo.vehicletype.setMaxSpeed(name, speed)
        sumo.vehicle.add(name, name, name, departSpeed="max")

    def step(self, moves: list[list[tuple[int, float | None, float | None, float | None]]], share: float) -> Rows:
        """Drive for some steps; return the rows after a share of the last one.

        `moves` are rows for each step, vehicle, x, y, angle: it is there after the step; null: taken off.
        """
        vehicle = self.sumo.vehicle
        for moved in moves:
            for i, x, y, angle in moved:
                name = self.names[i]
                if name in self.now and x is None:
                    vehicle.remove(name)
                elif name in self.now:
                    vehicle.moveToXY(name, "", -1, x, y, angle, 3)  # on its route, and exactly there
            self.sumo.simulationStep()
            self.before, self.now = self.now, self.places()
        return self.rows(share)

    def places(self) -> dict[str, Place]:
        """Return where all vehicles are."""
        vehicle = self.sumo.vehicle
        return {name: (*vehicle.getPosition(name), vehicle.getAngle(name)) for name in vehicle.getIDList()}

    def place(self, name: str, share: float) -> Place:
        """Return where a vehicle was after a share of the last step, in which SUMO moves it at one speed."""
        x, y, angle = self.now[name]
        x0, y0, angle0 = self.before.get(name, self.now[name])
        rest, turned = 1.0 - share, (angle - angle0 + 180.0) % 360.0 - 180.0
        return x - rest * (x - x0), y - rest * (y - y0), angle - rest * turned

    def rows(self, share: float) -> Rows:
        """Return x, y, angle, speed of the scenario's vehicles (NaN: not there), and x, y, angle, size of others."""
        vehicle, own, others = self.sumo.vehicle, array("d"), array("d")
        there = dict.fromkeys(self.now)
        for name in self.names:
            if name in there:
                del there[name]
                own.extend((*self.place(name, share), vehicle.getSpeed(name)))
            else:
                own.extend((NAN,) * 4)
        for name in there:
            if name not in self.sizes:
                self.sizes[name] = vehicle.getLength(name), vehicle.getWidth(name), vehicle.getHeight(name)
            others.extend((*self.place(name, share), *self.sizes[name]))
        return own, others


def main() -> None:
    """Answer requests until the input ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the program that has started it ends it
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # SUMO's output
    traffic = None
    for line in sys.stdin.buffer:
        try:
            traffic = traffic or SumoTraffic()
            request = json.loads(line)
            own, others = getattr(traffic, request.pop("do"))(**request)
            replies.write(json.dumps({"own": len(own) // 4, "others": len(others) // 6}).encode() + b"\n")
            replies.write(own.tobytes() + others.tobytes())
        except Exception as error:
            replies.write(json.dumps({"error": str(error) or type(error).__name__}).encode() + b"\n")
        replies.flush()


if __name__ == "__main__":
    main()
