# gaponet without CUDA and DDS:  docker build -t gaponet .  and  docker run --rm -it -v "$PWD:/work" gaponet demo --real
# The page of gaponet app is served to the machine it runs on: add --network host (Linux).
FROM python:3.12-slim

# EGL draws the pictures of reports and films without a display; libgl1 brings Mesa's software renderer.
RUN apt-get update \
    && apt-get install -y --no-install-recommends git libegl1 libgl1 \
    && rm -rf /var/lib/apt/lists/*
ENV MUJOCO_GL=egl

# torch first and from its CPU index; the other packages are satisfied with it.
COPY constraints.txt /src/
RUN pip install --no-cache-dir "$(grep ^torch== /src/constraints.txt)" --index-url https://download.pytorch.org/whl/cpu
COPY . /src
RUN pip install --no-cache-dir -c /src/constraints.txt "/src[train,gym,so101,zmq,ros,hdf5,hub,film]"

WORKDIR /work
ENTRYPOINT ["gaponet"]
