"""Builds the documentation site, `make docs`: pages made from the project, links into the repository, notebooks."""
