# cosim with what a run needs: docker build -t cosim . && docker run --rm -v "$PWD:/data" cosim run
# Not tried by the maintainers: cosim/docs/pages/reference/platforms.md.
FROM python:3.12-slim

WORKDIR /opt/cosim
COPY . .
RUN pip install --no-cache-dir --require-hashes -r requirements.lock \
    && pip install --no-cache-dir --no-deps --no-build-isolation .

ENV HOME=/tmp
WORKDIR /data
ENTRYPOINT ["cosim"]
