"""What may be wrong with a scenario that is possible all the same."""


class ScenarioWarning(UserWarning):
    """The scenario is possible but the theory's conditions may not hold."""
