"""The section `[highway]`: which environment of highway-env moves the vehicles."""

from typing import Annotated

from pydantic import Field

from coopenv.base.sections import Section
from coopenv.scenario.base import Number, Word

Setting = bool | int | Number | Word | tuple[Number, ...] | None


class Highway(Section):
    """Roads, traffic (IDM and MOBIL) and dynamics of an environment of highway-env, see docs/highway.md."""

    id: Annotated[str, Field(max_length=64, pattern=r"^[a-z0-9][A-Za-z0-9-]*-v\d+$")]
    """Its id in Gymnasium's registry, such as `intersection-v0`."""
    config: dict[str, Setting] = Field(default={})
    """Its own configuration by key; settings of this file (rates, sizes of actions) are not repeated here."""
    dynamical: bool = False
    """Whether driven vehicles have tyres that slip (highway-env's BicycleVehicle); otherwise its kinematic bicycle."""
    most_vehicles: int = Field(default=40, ge=0, le=1000)
    """Vehicles on its road at most, besides those of this file: the traffic that only occludes and collides."""
