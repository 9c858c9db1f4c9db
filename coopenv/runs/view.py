"""`coopenv view`: the server and its picture."""

from collections.abc import Callable
from contextlib import suppress
from time import monotonic, sleep
from typing import Any

import numpy as np

from coopenv.base.errors import CoopenvError, error_text
from coopenv.episode import Frame
from coopenv.runs.live import FAULTS, Reel
from coopenv.runs.scenes import MAX_FPS
from coopenv.viz.stage import Stage, entries
from coopenv.viz.web import aim
from coopenv.viz.web_panel import LONGEST, NO_FAULT, Panel
from coopenv.viz.web_picture import Picture, first_look

_NAP = 0.05  # s, longest sleep: wishes are not kept waiting longer
_LAG = 0.5  # s that frames may be late before time is let go
_FADE_EVERY = 0.25  # s
_RAISED = 0.3  # of the scene's side, by which it is lifted over the panel at the lower end of a narrow window
_NEAR, _LENGTHS = 0.2, 12.0  # share of the first camera's distance from a picked vehicle, or so many of its lengths
_NARROW = 0.7  # width over height of a window, from which on the camera begins farther away


class Viewer:
    """Shows a reel through a server of viser."""

    def __init__(self, server: Any, reel: Reel) -> None:
        """Draw the first frame.

        Raises:
            CoopenvError: there is none.
        """
        if not reel.more():
            raise CoopenvError(f"{reel.source.name}: has no frames to show")
        self._server, self._reel = server, reel
        self._stage = Stage(reel.scenario)
        self._look = first_look(reel.frames[0].three_sigma, self._stage, reel.source)
        self._panel = Panel(server.gui, self._stage, reel.source, self._look, reel.abilities, reel.length)
        aim(server.initial_camera, self._stage)
        self._picture = Picture(server.scene, self._stage, reel.source, self._look)
        self._picture.actors.cars.handle.on_click(lambda event: self._panel.wishes.update(vehicle=event.instance_index))
        server.on_client_connect(self._welcome)
        self._k, self._speed, self.playing = 0, 1.0, True
        self._live, self._near = not reel.abilities.pace, 1.0
        self._due = self._shown_at = self._faded_at = -np.inf
        self.shown = 0
        """Number of frames sent."""
        self._show(monotonic())

    def pick(self, vehicle: int | None) -> None:
        """Look at a vehicle from near, or at all of them."""
        self._panel.pick(vehicle)
        own = 0.0 if vehicle is None else self._stage.bodies()[0][vehicle, 0]
        self._near = 1.0 if vehicle is None else max(_NEAR, _LENGTHS * own / self._stage.side)
        aim(self._server.initial_camera, self._stage, near=self._near)
        for client in self._server.get_clients().values():
            self._aim(client.camera)

    def _aim(self, camera: Any) -> None:
        """Point a client's camera at the picked vehicle, or at everything."""
        narrow = camera.aspect < _NARROW
        with suppress(ValueError):  # of a camera that has no direction
            aim(camera, self._stage, float(camera.aspect), _RAISED if narrow else 0.0, self._near)

    def run(self, going: Callable[[], bool] = lambda: True) -> None:
        """Show frames until `going` returns False."""
        self._due = monotonic()
        while going():
            changed = self._obey()
            now = monotonic()
            moved = self._go_on(now) if self.playing or self._live else False
            if (moved and now - self._shown_at >= 0.9 / MAX_FPS) or changed:
                self._show(now)
            self._fade(now)
            if not self._live:  # cars wait themselves
                sleep(max(0.0, min(_NAP, self._due - monotonic())) if self.playing else _NAP)

    def _go_on(self, now: float) -> bool:
        """Go to the frame that is due; return whether another one is."""
        if not self._live and now < self._due:
            return False
        if now - self._due > _LAG:
            self._due = now
        if not self._step():
            self._live = False
            self._set_playing(False)
            again = "; Restart shows it again" if self._reel.abilities.pace else ""
            self._panel.set_status(f"The episode is over{again}.")
            return False
        ticks = self._frame.tick - self._reel.frames[self._k - 1].tick
        self._due += float(ticks) / self._reel.scenario.rates.camera / self._speed
        return True

    def _step(self) -> bool:
        """Go to the next frame; return False where there is none."""
        if self._k + 1 == len(self._reel.frames) and not self._reel.more():
            return False
        self._k += 1
        return True

    @property
    def _frame(self) -> Frame:
        return self._reel.frames[self._k]

    def _show(self, now: float) -> None:
        """Send the present frame; slow browsers get the latest one only, because messages replace one another."""
        picked = self._look.picked
        with self._server.atomic():
            self._picture.show(self._frame, self.shown if self.playing else None)
            place = np.zeros(3)
            if picked is not None and self._look.follow and np.isfinite(self._frame.position[picked]).all():
                place = self._stage.middle - [*self._frame.position[picked, :2], 0.0]
            self._picture.ground.root.position = tuple(np.round(place, 4).tolist())
            frames = self._reel.frames[max(0, self._k + 1 - LONGEST) : self._k + 1]
            self._panel.show(frames, now, exact=not self.playing)
        self._shown_at = now
        self.shown += 1

    def _fade(self, now: float) -> None:
        """Make buildings transparent that hide the picked vehicle, or any, from the viewer."""
        if now - self._faded_at < _FADE_EVERY or not self._stage.buildings:
            return
        self._faded_at = now
        picked = self._look.picked
        places = self._frame.position[[picked]] if picked is not None else self._frame.position
        root = np.array(self._picture.ground.root.position)
        places = places[np.isfinite(places).all(axis=1)]
        eyes = [np.array(client.camera.position) - root for client in self._server.get_clients().values()]
        paths = [(eye, place - eye) for eye in eyes for place in places]
        start, path = np.array(paths).reshape(-1, 2, 3).swapaxes(0, 1)
        between = entries(start, path, self._stage.buildings) < 1.0
        self._picture.ground.fade(np.asarray(between.any(axis=1)))

    def _welcome(self, client: Any) -> None:
        """Start farther away in a narrow window."""
        waiting = client.camera.aspect < _NARROW

        def once(camera: Any) -> None:
            nonlocal waiting
            arrived = np.linalg.norm(camera.look_at - self._stage.middle) < 1e-3 * self._stage.side
            if waiting and arrived:  # the first camera is there, which would come after what is set before
                waiting = False
                self._aim(camera)

        client.camera.on_update(once)

    def _obey(self) -> bool:
        """Carry out the user's requests; return whether there were any. An error is shown in the panel."""
        names = list(self._panel.wishes)
        for name in names:
            value = self._panel.wishes.pop(name)
            try:
                if name.startswith("show "):
                    setattr(self._look, name.removeprefix("show "), value)
                else:
                    getattr(self, f"_wish_{name}")(value)
            except Exception as error:  # a wish never ends the view
                self._panel.set_status(
                    f"That cannot be: {error if isinstance(error, CoopenvError) else error_text(error)}"
                )
        return bool(names)

    def _set_playing(self, playing: bool) -> None:
        self.playing, self._due = playing, monotonic()
        self._panel.set_playing(playing)

    def _wish_play(self, _: object) -> None:
        self._set_playing(not self.playing)
        self._panel.set_status("")

    def _wish_go(self, action: str) -> None:
        getattr(self, f"_wish_{action}")(None)

    def _wish_step(self, _: object) -> None:
        self._set_playing(False)
        self._step()

    def _wish_restart(self, _: object) -> None:
        self._k = 0
        self._panel.set_status("")
        self._set_playing(True)

    def _wish_speed(self, speed: float) -> None:
        self._speed, self._due = speed, monotonic()

    def _wish_seek(self, time: float) -> None:
        self._set_playing(False)
        tick = time * self._reel.scenario.rates.camera
        while self._reel.frames[-1].tick < tick and self._reel.more():
            pass
        ticks = np.array([frame.tick for frame in self._reel.frames])
        self._k = int(np.argmin(np.abs(ticks - tick)))

    def _wish_vehicle(self, vehicle: int | None) -> None:
        if vehicle in (None, *range(self._stage.vehicles)):  # a client can click on any number
            self.pick(vehicle)

    def _wish_magnification(self, magnification: float) -> None:
        self._look.magnification = magnification
        self._panel.update_legend()

    def _wish_observer(self, name: str) -> None:
        self._change(f"Running this episode under {name} up to here", observer=name)

    def _wish_fault(self, name: str) -> None:
        time = float(self._frame.tick) / self._reel.scenario.rates.camera
        fault = {} if name == NO_FAULT else FAULTS[name](time, self._look.picked or 0)
        self._change("Running this episode again up to here", fault=fault)

    def _change(self, words: str, **changes: Any) -> None:
        """Run the episode again up to here under changes."""
        self._panel.set_status(f"{words} (kernels that are new here are compiled first) ...")
        self._server.flush()
        self._reel.change(**changes)
        self._k = min(self._k, len(self._reel.frames) - 1)
        self._picture.actors.set_source(self._reel.source)
        self._panel.set_source(self._reel.source)
        self._panel.set_status("")
        self._due = monotonic()
