# One image for the API with its map page and for the worker. It has no PostgreSQL server for a private
# cluster, so it needs AMERS_DATABASE_URL: see docker-compose.yml.
#
# Bases by tag, as they are updated. `scripts/pin-images` prints them with their digests of this moment.
ARG NODE_IMAGE=node:22-bookworm-slim
ARG PYTHON_IMAGE=python:3.12-slim-bookworm

FROM ${NODE_IMAGE} AS page

WORKDIR /build/web
COPY web/package.json web/package-lock.json ./
RUN --mount=type=cache,target=/root/.npm npm ci --ignore-scripts --no-audit --no-fund
COPY web ./
RUN npm run check && npm run build

FROM ${PYTHON_IMAGE} AS build

WORKDIR /build
RUN python -m venv /opt/amers
# Only files with a known hash; scripts/make-requirements wrote them down.
COPY requirements.txt ./
RUN --mount=type=cache,target=/root/.cache/pip /opt/amers/bin/pip install --require-hashes -r requirements.txt
COPY pyproject.toml README.md LICENSE ./
COPY amers amers
COPY app app
COPY migrations migrations
COPY services services
COPY --from=page /build/app/web/built app/web/built
RUN /opt/amers/bin/pip install --no-index --no-deps --no-build-isolation . && /opt/amers/bin/pip check

FROM ${PYTHON_IMAGE}

# libexpat1: a system library of the raster driver's wheel. postgresql-client: amers db backup and restore;
# its version is not older than the server of docker-compose.yml.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends libexpat1 postgresql-client \
    && rm -rf /var/lib/apt/lists/* \
    && useradd --system --uid 10001 --home-dir /var/lib/amers --create-home amers

COPY --from=build /opt/amers /opt/amers

ENV PATH=/opt/amers/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    OPENBLAS_NUM_THREADS=1 \
    OMP_NUM_THREADS=1 \
    NUMBA_CACHE_DIR=/var/lib/amers/numba \
    AMERS_DATA_FOLDER=/var/lib/amers \
    AMERS_HOST=0.0.0.0

USER amers
VOLUME /var/lib/amers
EXPOSE 8000
STOPSIGNAL SIGTERM
CMD ["amers", "serve", "--no-worker"]
