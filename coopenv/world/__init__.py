"""Truth and sensing as Warp kernels, one file per stage, batched over worlds and vehicles."""
