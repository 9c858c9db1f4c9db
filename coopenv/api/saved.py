"""The common base of all environments of an engine: layout, text, picture, and states that are saved and restored."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn, Self

from coopenv.api.engine import Engine
from coopenv.api.terms.layout import Layout
from coopenv.base.columns import facts_html, one_line, picture_html
from coopenv.base.errors import CoopenvError, Explained
from coopenv.scenario import Scenario

NO_PICTURE = "render() shows nothing: make the environment with render_mode='rgb_array'"
RENDER_HINT = "; render_mode is given where the environment is made"


class Saved(Explained):
    """Base class of the environments of an engine: its layout, and states that are saved and restored."""

    engine: Engine
    scenario: Scenario
    metadata: dict[str, Any]
    close: Any
    _arguments: dict[str, Any]
    """Arguments that build an equal environment."""

    @property
    def observation_layout(self) -> Layout:
        """Name, slice, unit and scale of every field of the flat observation."""
        return self.engine.layout.copy()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def __len__(self) -> int:
        """Return the number of vehicles in all worlds."""
        return self.engine.world.worlds * len(self.scenario.vehicles)

    def __getitem__(self, key: object) -> NoReturn:
        """Refuse, also iteration and `in`, which ask for this."""
        raise TypeError(f"'{type(self).__name__}' object is not subscriptable; reset() and step() return one per agent")

    def __repr__(self) -> str:
        return one_line(self, self.metadata["name"].removesuffix("_v0"), self._facts)

    def _repr_html_(self) -> str:
        """Return the main figures and, once an episode has begun, the top view of the first world."""
        picture = picture_html(self.engine.picture()) if self.engine.begun else ""
        return facts_html(self.scenario.title, self._facts) + picture

    @property
    def _facts(self) -> dict[str, object]:
        worlds = {} if self.engine.world.worlds == 1 else {"worlds": self.engine.world.worlds}
        return {**worlds, **self.scenario.facts}

    def get_state(self) -> dict[str, Any]:
        """Return everything that the next step depends on, random streams included; see `set_state`."""
        return {"scenario": self.scenario, **self.engine.get_state()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`, of this or an equal environment.

        A state is data except for plug-in observers, which are objects: a pickled state of unknown origin is as
        dangerous as any pickle.

        Raises:
            CoopenvError: it is of another kind of environment, or not valid; nothing has changed then.
        """
        try:
            if not isinstance(state, Mapping):
                raise CoopenvError(f"not a mapping, but {type(state).__name__}")
            if state.get("scenario") != self.scenario:
                raise CoopenvError("it is of another scenario")
            self._restore(state)
        except CoopenvError as error:
            raise CoopenvError(f"this state does not fit {self.metadata['name']}: {error}") from None

    def _restore(self, state: Mapping[str, Any]) -> None:
        self.engine.set_state(state)

    def __getstate__(self) -> dict[str, Any]:
        return {"arguments": self._arguments, "state": self.get_state()}

    def __setstate__(self, saved: dict[str, Any]) -> None:
        self.__init__(**saved["arguments"])  # type: ignore[misc]
        self.set_state(saved["state"])
