"""Constants of cars from their drives."""
