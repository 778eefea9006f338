# syntax=docker/dockerfile:1
# The cloud half. From the top of a working copy:
#
#   docker build -f docker/server.Dockerfile -t comvla-server .
#   docker run --rm -p 127.0.0.1:50051:50051 -p 127.0.0.1:8080:8080 comvla-server serve --insecure
#
# TORCH_INDEX_URL is handed to install.sh: empty brings CUDA (run with --gpus all and
# COMVLA_DEVICE=cuda:0), the address of PyTorch's CPU builds an image of a third of the size.
FROM debian:12-slim

ARG TORCH_INDEX_URL=""
RUN --mount=type=bind,target=/src,rw \
    TORCH_INDEX_URL="$TORCH_INDEX_URL" /src/docker/install.sh server /src

ENV PATH=/opt/comvla/bin:/usr/bin:/bin \
    PYTHONUNBUFFERED=1 \
    COMVLA_HOST=0.0.0.0 \
    COMVLA_PORT=50051 \
    COMVLA_ADMIN_PORT=8080 \
    COMVLA_LOG_FORMAT=json \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility

# Checkpoints: mount them here, read-only, and say --model /models/NAME.
VOLUME /models
WORKDIR /models
USER 10001:10001
EXPOSE 50051 8080
STOPSIGNAL SIGTERM
HEALTHCHECK --interval=10s --timeout=5s --start-period=120s --retries=3 CMD ["comvla-healthcheck"]
ENTRYPOINT ["comvla-server"]
CMD ["serve"]
