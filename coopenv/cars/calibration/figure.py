"""Residuals of a calibration as a figure."""

import numpy as np
from matplotlib.figure import Figure

from coopenv.cars.calibration.calibrate import Calibrated
from coopenv.viz import style

MOST_ARROWS = 400


def residual_figure(result: Calibrated, c: int) -> Figure:
    """Draw the residuals of one car: sightings in the image and by landmark, motion capture against time."""
    batch, car = result.batch, result.batch.cars[c]
    fits = (("as given", result.given, style.VERMILION), ("calibrated", result.fit, style.BLUE))
    parts = [batch.residuals(c, fit.x, fit.poses[c]) for _, fit, _ in fits]
    figure = style.new_figure(style.PAGE, 7.0)
    grid = figure.subplots(2, 2)
    unit, scale = ("px", 1.0) if car.lens is not None else ("mrad", 1e3)
    image, marks, time, truth = grid.flat
    for (label, _, colour), (seen, _, known) in zip(fits, parts, strict=True):
        some = np.unique(np.linspace(0, len(seen) - 1, MOST_ARROWS).astype(int))
        if car.lens is not None:
            arrows = {"angles": "xy", "scale_units": "xy", "scale": 0.1, "width": 0.002}
            image.quiver(*car.pixel[some].T, *seen[some].T, color=colour, label=label, **arrows)
        length = scale * np.linalg.norm(seen, axis=-1)
        names = batch.drive.landmarks
        rms = [
            np.sqrt(np.mean(length[car.target == i] ** 2)) if (car.target == i).any() else 0 for i in range(len(names))
        ]
        side = -0.2 if label == "as given" else 0.2
        marks.bar(np.arange(len(names)) + side, rms, 0.4, color=colour, label=label)
        order = np.argsort(car.time, kind="stable")
        style.draw_band(time, car.time[order], length[order], style.bins_of(4.5), color=colour, label=label)
        if len(known):
            off = 1e3 * np.linalg.norm(known[:, :2], axis=-1)
            style.draw_band(truth, car.truth_time, off, style.bins_of(4.5), color=colour, label=label)
    if car.lens is not None:
        width, height = car.lens.image_size
        image.set(xlim=(0, width), ylim=(height, 0), aspect="equal")
        image.set_title("Residuals of sightings in the image, 10 times as long", **style.TEXT)
        style.tidy(image, x_label="u [px]", y_label="v [px]")
    else:
        image.axis("off")
    marks.set_xticks(range(len(batch.drive.landmarks)), batch.drive.landmarks, rotation=60 if len(names) > 8 else 0)
    style.tidy(marks, x_label="landmark", y_label=f"RMS residual [{unit}]")
    style.tidy(time, x_label="time [s]", y_label=f"residual of sightings [{unit}]")
    style.tidy(truth, x_label="time [s]", y_label="position against motion capture [mm]")
    for axes in (marks, time, truth):
        axes.set_ylim(bottom=0.0)
    if not len(parts[0][2]):
        truth.axis("off")
        truth.text(0.5, 0.5, "no motion capture", ha="center", transform=truth.transAxes, **style.TEXT)
    figure.legend(*marks.get_legend_handles_labels(), loc="upper right", fontsize=style.SMALL, frameon=False)
    figure.suptitle(f"Residuals of {car.name}", fontsize=style.NORMAL)
    style.explain(figure, "Lines: medians; bands: 10 to 90 %.")
    figure.tight_layout()
    return figure
