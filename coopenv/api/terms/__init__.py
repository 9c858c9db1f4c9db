"""Terms at work: the layout of observations, the functions of coopenv's terms, and the kernels made from them."""
