# The pipeline with everything that it needs, on the processor. TORCH_INDEX is the index of torch's CPU builds (the one
# that its installation page names for "CPU"); packages are those of requirements.lock, held by their hashes.
#
#   docker build --build-arg TORCH_INDEX=URL -t bearing-identification .
#   docker run --rm -v "$PWD:/work" --user "$(id -u):$(id -g)" bearing-identification stage=identify machine.file=my_machine.yaml
FROM python:3.11-slim AS packages
ARG TORCH_INDEX=""
COPY requirements.lock /
RUN python -m venv /opt/venv \
    && /opt/venv/bin/pip install --no-cache-dir --require-hashes ${TORCH_INDEX:+--extra-index-url "$TORCH_INDEX"} \
        -r /requirements.lock
COPY pyproject.toml README.md /opt/pipeline/
COPY pipeline /opt/pipeline/pipeline
COPY conf /opt/pipeline/conf
COPY studies /opt/pipeline/studies
RUN /opt/venv/bin/pip install --no-cache-dir --no-deps --no-build-isolation -e /opt/pipeline \
    && mkdir -m 1777 /opt/pipeline/.cache

FROM python:3.11-slim
RUN useradd --create-home --uid 1000 engineer && mkdir /work /records && chown engineer /work /records
COPY --from=packages /opt /opt
# HOME for a user whom the image does not know (--user).
ENV PATH=/opt/venv/bin:$PATH HOME=/tmp MLFLOW_DISABLE_TELEMETRY=true DO_NOT_TRACK=1 DVC_NO_ANALYTICS=1
USER engineer
WORKDIR /work
ENTRYPOINT ["python", "-m", "pipeline"]
