# coopenv for simulation, logs and benchmarks, without torch; results go to the folder that is mounted.
#
#   docker build -f docker/coopenv.Dockerfile -t coopenv .
#   docker run --rm -v "$PWD/out":/work/out coopenv run busy_intersection
#
FROM python:3.11-slim

ENV PYTHONUNBUFFERED=1 PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 MPLBACKEND=Agg WARP_CACHE_PATH=/work/.warp

COPY . /src
RUN pip install --constraint /src/constraints.txt '/src[log,video]' && rm -rf /src

RUN useradd --uid 1000 --create-home coopenv && mkdir -p /work/out && chown -R coopenv /work
USER coopenv
WORKDIR /work
ENTRYPOINT ["coopenv"]
CMD ["--help"]
