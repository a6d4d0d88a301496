# gaponet with everything but CUDA:  docker build -t gaponet .  and  docker run --rm -it -v "$PWD:/work" gaponet demo --real
FROM python:3.12-slim

# EGL draws the pictures of reports and films without a display.
RUN apt-get update \
    && apt-get install -y --no-install-recommends git libegl1 libgl1 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl

COPY . /src
RUN pip install --no-cache-dir torch --index-url https://download.pytorch.org/whl/cpu \
    && pip install --no-cache-dir "/src[train,hub]"

WORKDIR /work
ENTRYPOINT ["gaponet"]
