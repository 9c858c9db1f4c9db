# The command gate of one car, and nothing else; see docs/cars_safety.md.
#
#   docker build -f docker/car.Dockerfile -t coopenv-gate .
#
FROM python:3.11-slim

ENV PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1 PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1

COPY . /src
RUN pip install --upgrade 'pip>=25.1' && pip install --no-deps /src \
    && pip install --constraint /src/constraints.txt --group /src/pyproject.toml:gate && rm -rf /src

# Keys and deployment are mounted here, readable for the user that runs the container and nobody else.
VOLUME /etc/coopenv
RUN useradd --system --uid 1000 --no-create-home coopenv
USER coopenv

ENV CAR=svea7
# No port is exposed: the gate connects to the car's own bridge or router, [gate] connect, and not to what network.connect
# names, which the radio may part it from. With car-zenoh.json5 that is the unix socket in /run/coopenv, to be mounted.
# The check reads the gate's status and sends nothing: a check that sends commands could stop a car that drives.
HEALTHCHECK --interval=30s --timeout=10s --start-period=10s --retries=2 \
    CMD coopenv svea health /etc/coopenv/fleet.toml --car "$CAR" --read-only || exit 1

# Neutral goes out before the gate does.
STOPSIGNAL SIGTERM
CMD exec coopenv svea gate /etc/coopenv/fleet.toml --car "$CAR"
