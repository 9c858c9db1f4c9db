"""ROS bags of any laboratory: the backend, topic maps, clocks, and readers of their files."""
