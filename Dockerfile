# waldnet in a container: `docker build -t waldnet .`, then `docker run waldnet --help`.
# Package installs need the usual index, or another one by --build-arg PIP_INDEX_URL=...; certificates of a company's
# own authority come with the base image or by PIP_CERT, a path inside it.
ARG PYTHON_IMAGE=python:3.11-slim

FROM ${PYTHON_IMAGE} AS build
LABEL org.opencontainers.image.title=waldnet
ARG PIP_INDEX_URL
ARG PIP_EXTRA_INDEX_URL
ARG PIP_TRUSTED_HOST
ARG PIP_CERT
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /build
COPY requirements/user.lock requirements/
RUN python -m venv /opt/waldnet && /opt/waldnet/bin/pip install --require-hashes -r requirements/user.lock
COPY . .
RUN /opt/waldnet/bin/pip install --no-deps --no-build-isolation . \
    && /opt/waldnet/bin/pip uninstall --yes setuptools pip \
    && find /opt/waldnet -type d -name tests -prune -exec rm -r {} +

FROM ${PYTHON_IMAGE}
LABEL org.opencontainers.image.title=waldnet
COPY --from=build /opt/waldnet /opt/waldnet
# Nothing is written at run time; modules never come from the working directory.
ENV PATH=/opt/waldnet/bin:$PATH PYTHONDONTWRITEBYTECODE=1 PYTHONSAFEPATH=1 PYTHONUNBUFFERED=1
USER 10001:10001
WORKDIR /scenarios
ENTRYPOINT ["waldnet"]
