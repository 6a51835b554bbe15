# greybox with a C compiler and PyTorch's CPU build:  docker build -t greybox . && docker run --rm -v "$PWD:/work" greybox fit --help
FROM python:3.11-slim
RUN apt-get update && apt-get install -y --no-install-recommends gcc libc6-dev && rm -rf /var/lib/apt/lists/*
COPY . /src
RUN pip install --no-cache-dir torch --index-url https://download.pytorch.org/whl/cpu \
 && pip install --no-cache-dir -c /src/constraints.txt "/src[gp,logs]" && rm -rf /src
WORKDIR /work
ENTRYPOINT ["greybox"]
