# uuvtai on the CPU: docker build -t uuvtai . && docker run --rm -v "$PWD/runs:/home/uuv/runs" -v uuvtai-cache:/home/uuv/.cache uuvtai eval
FROM python:3.12-slim-bookworm AS build
WORKDIR /src
COPY pyproject.toml README.md LICENSE MANIFEST.in ./
COPY uuvtai ./uuvtai
COPY examples ./examples
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /dist .

FROM python:3.12-slim-bookworm
# Taichi is linked to libX11, though nothing here opens a window
RUN apt-get update && apt-get install --yes --no-install-recommends libx11-6=2:1.8.* && rm -rf /var/lib/apt/lists/*
# torch alone first: with --build-arg TORCH_INDEX=<an index of CPU builds> a few hundred MB instead of several GB of CUDA libraries
ARG TORCH_INDEX
RUN pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "torch>=2.10,<2.14"
COPY --from=build /dist /dist
RUN pip install --no-cache-dir /dist/*.whl && rm -r /dist \
    && useradd --create-home --uid 1000 uuv \
    && mkdir -p /home/uuv/runs /home/uuv/.cache/taichi && chown -R uuv:uuv /home/uuv
USER 1000
WORKDIR /home/uuv
# results, and the kernels that the first run compiles
VOLUME ["/home/uuv/runs", "/home/uuv/.cache"]
ENTRYPOINT ["uuv"]
CMD ["--help"]
