"""Learned agents by environment, arm and seed: trained side by side, resumed, judged, and told on cards."""
