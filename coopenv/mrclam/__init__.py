"""The data set MR.CLAM, recorded robots on a plane, and observers for such robots."""
