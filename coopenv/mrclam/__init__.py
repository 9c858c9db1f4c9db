"""The data set MR.CLAM: recorded robots on a level floor."""
