"""The array type of NumPy code."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
