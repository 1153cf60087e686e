# docker build -t pacesetter . && docker run -v "$PWD/runs:/work/runs" pacesetter train td3 Pendulum-v1
FROM python:3.12-slim
# Videos are drawn by EGL, without a display.
RUN apt-get update \
    && apt-get install -y --no-install-recommends libegl1 libgl1 \
    && rm -rf /var/lib/apt/lists/*
COPY pyproject.toml hatch_build.py README.md LICENSE /source/
COPY champions /source/champions
COPY src /source/src
RUN pip install --no-cache-dir /source && rm -r /source
WORKDIR /work
ENTRYPOINT ["pacesetter"]
CMD ["--help"]
