"""What tests share: scenarios and worlds from plain data, callers of Warp functions, recordings, files, runs."""
