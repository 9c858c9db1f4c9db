"""The gate on a car, the only process that commands its wheels."""
