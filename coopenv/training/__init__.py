"""`coopenv train`: PPO of Stable-Baselines3 with one policy for all vehicles, from settings to an agent's folder."""
