# To develop coopenv: Python, make, git and the browser of `make test-browser`. The repository is mounted, not copied.
#
#   docker build -f docker/dev.Dockerfile -t coopenv-dev .
#   docker run --rm -it -v "$PWD":/workspace -w /workspace coopenv-dev make test
#
FROM python:3.11-bookworm

RUN apt-get update && apt-get install --yes --no-install-recommends chromium && rm -rf /var/lib/apt/lists/*
ENV PIP_DISABLE_PIP_VERSION_CHECK=1
