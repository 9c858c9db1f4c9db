"""The gate for recordings and live cars: every stream is compared with every other before an observer sees it."""
