"""Settings of cars: the make's profile, the deployment of a fleet, sensors."""
