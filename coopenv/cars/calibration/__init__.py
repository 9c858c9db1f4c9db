"""Calibration of cars from one drive: constants by one batch least squares, and which of them are wrong."""
