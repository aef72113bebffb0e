# One image for the API, the worker and every other command of the program.
FROM python:3.12-slim-bookworm@sha256:782412e85d0f0984994c290652577d4018aff08145c85b262bb63dc0c7522254 AS build
WORKDIR /src
RUN python -m venv /opt/fluoromap
COPY requirements.lock ./
RUN /opt/fluoromap/bin/pip install --no-cache-dir --require-hashes -r requirements.lock
COPY requirements-build.lock ./
RUN python -m venv /opt/build && /opt/build/bin/pip install --no-cache-dir --require-hashes -r requirements-build.lock
COPY pyproject.toml README.md LICENSE ./
COPY plugins plugins
COPY service service
COPY workers workers
COPY migrations migrations
# Without --no-index and --no-deps pip could fetch a package that no lock holds.
RUN /opt/build/bin/python -m hatchling build --target wheel --directory /opt/wheel \
    && /opt/fluoromap/bin/pip install --no-cache-dir --no-index --no-deps /opt/wheel/*.whl

FROM python:3.12-slim-bookworm@sha256:782412e85d0f0984994c290652577d4018aff08145c85b262bb63dc0c7522254
RUN useradd --uid 10001 --user-group --no-create-home --home-dir /var/lib/fluoromap --shell /usr/sbin/nologin fluoromap \
    && install -d -o fluoromap -g fluoromap -m 0750 /var/lib/fluoromap
COPY --from=build /opt/fluoromap /opt/fluoromap
ENV PATH=/opt/fluoromap/bin:/usr/local/bin:/usr/bin:/bin \
    PYTHONUNBUFFERED=1 \
    FLUOROMAP_DATA_DIR=/var/lib/fluoromap \
    FLUOROMAP_HOST=0.0.0.0 \
    FLUOROMAP_PORT=8000
USER fluoromap
VOLUME /var/lib/fluoromap
EXPOSE 8000
ENTRYPOINT ["fluoromap"]
CMD ["api"]
