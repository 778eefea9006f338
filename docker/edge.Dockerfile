# syntax=docker/dockerfile:1
# The robot's half: the SDK and its commands. From the top of a working copy:
#
#   docker build -f docker/edge.Dockerfile -t comvla-edge .
#   docker run --rm --network host comvla-edge doctor 127.0.0.1:50051
FROM debian:12-slim

ARG TORCH_INDEX_URL=""
RUN --mount=type=bind,target=/src,rw \
    TORCH_INDEX_URL="$TORCH_INDEX_URL" /src/docker/install.sh edge /src

ENV PATH=/opt/comvla/bin:/usr/bin:/bin \
    PYTHONUNBUFFERED=1

VOLUME /models
WORKDIR /models
USER 10001:10001
STOPSIGNAL SIGTERM
ENTRYPOINT ["comvla"]
CMD ["--help"]
