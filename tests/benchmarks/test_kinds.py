"""The sets of sensors of the benchmark of kinds."""

from benchmarks.kinds import BESIDE, CAMERA, EVERYTHING, RATES, sensor_sets
from coopenv.measurements.table import KINDS
from coopenv.scenario import load_scenario


def test_each_kind_stands_alone_and_all_stand_together() -> None:
    scenarios = {
        name: load_scenario("busy_intersection_tracking", RATES | keys) for name, keys in sensor_sets().items()
    }
    kinds = {name: [sensor.kind for sensor in scenario.sensors] for name, scenario in scenarios.items()}
    assert kinds == {CAMERA: [], **{kind: [kind] for kind in KINDS}, BESIDE: ["range"], EVERYTHING: [*KINDS]}
    with_camera = {name for name, scenario in scenarios.items() if scenario.camera.model != "none"}
    assert with_camera == {CAMERA, BESIDE, EVERYTHING}
    landmarks = scenarios["range"].sensors[0]
    assert landmarks.measures(scenarios["range"], 0) and not scenarios[BESIDE].sensors[0].measures(scenarios[BESIDE], 0)
