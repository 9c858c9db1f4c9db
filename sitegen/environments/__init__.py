"""Pages of the environments: description, picture, film and the value of sensing of each."""
