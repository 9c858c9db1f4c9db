"""Reference implementations that share no code with coopenv, for its tests to compare against."""
