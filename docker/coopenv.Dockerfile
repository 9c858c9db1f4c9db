# coopenv for simulation, logs and benchmarks, without torch; results go to the folder that is mounted.
#
#   docker build -f docker/coopenv.Dockerfile -t coopenv .
#   docker run --rm -v "$PWD/out":/home/coopenv/out coopenv run busy_intersection
#
FROM python:3.11-slim

ENV PYTHONUNBUFFERED=1 PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1 MPLBACKEND=Agg WARP_CACHE_PATH=/home/coopenv/.warp

COPY . /src
# kernels are compiled here, because containers keep no cache
RUN pip install --constraint /src/constraints.txt '/src[log,video,view]' && python /src/benchmarks/kernels.py && rm -rf /src

RUN useradd --uid 1000 --create-home coopenv && mkdir /home/coopenv/out && chown coopenv /home/coopenv/out
USER coopenv
WORKDIR /home/coopenv
ENTRYPOINT ["coopenv"]
CMD ["--help"]
