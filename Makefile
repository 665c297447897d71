# make demo   one simulated sensor through the real daemon          make test   everything that needs no lab, in 5 minutes
# make test-thorough   every test and the long forms of fuzz, attack, lab, chaos, soak      make mutants   quality of the tests
# make lab    tests on a booted kernel          make chaos  random faults on a booted kernel (ARGS="--seed N --seconds S")
# make soak   100 devices, 20 clients, all recorded, an hour (ARGS="--seconds 120")
# make test-pythons   the tests on every supported Python that is here; those that are missing are named
# make check  ruff, mypy --strict, then the tests                   make bench  measurements, into build/bench.json
#                                                                   (ARGS=--short: at most 5 minutes)
# make report  measures and writes docs/measurements (ARGS="latency fleet": these pages; ARGS=--stored: without measuring)
# make alerts every alert of a daemon and of a fleet provoked, in a real Prometheus: fires and clears, with a table of times
# make signalk-deps   installs the Signal K server with npm into build/signalk, for the tests of the output signalk
# make monitoring-deps   installs Prometheus and Alertmanager, for the tests of rules, examples and dashboard
# make fleet-deps  installs PostgreSQL, for the tests of the collector, and what make mqtt-deps and make influx-deps install
# make influx-deps installs InfluxDB, for the tests of the output influx
# make mqtt-deps   installs mosquitto and nats-server, for the tests of the output mqtt and these:
# make fleet-demo    a broker, three gateways with a simulated sensor each, and `imud fleet top` on them
# make fleet-faults  a gateway, a broker and what can happen between them (ARGS="--seconds 120"), as a table
# make fleet-collectors  three collectors divide a fleet, and SIGKILL ends one of them every 20 s
# make fleet-load    cost of a broker, collectors and a database with 1,000 simulated gateways (ARGS="--gateways 10000")
# make fleet-scale   the same for many sizes, 20 minutes (ARGS=--short: 5 minutes)
# make fleet-retention   cost and size of 10 to 1000 stored days, in partitions and in TimescaleDB, 10 minutes
# make fleet-jetstream   three NATS servers store an hour for an absent collector; they are killed while it catches up
# make bench-instructions   instructions per sample, beside those kept in the tree; make bench-deps   what it needs
# make web-deps   installs chromium and its driver, for the tests of the page of `imud web`
# make pictures   the pictures of README.md and docs/, into docs/pictures
# make web-pictures   the pictures of `imud web`, in a real browser, into docs/pictures
# make docs-site      the documents as a site with a search, into build/site; fails on a dead link
# make fuzz   every decoder of foreign bytes, 60 s each, with a table
# make sanitize   tests of the C kernel with AddressSanitizer and UndefinedBehaviorSanitizer
# make audit  items of both manuals and of newer firmware: code and tests of each
# make deb    the Debian package of this release and architecture, into build/deb (RELEASE=trixie ARCH=arm64: of others)
# make apt-repository   a signed apt repository into build/apt (APT_KEY=FINGERPRINT APT_URL=ADDRESS, RELEASES, ARCHES)
# make apt-try   installs the package with the one line of such a repository in a Debian in a folder (as root; RELEASE, ARCH)
# make deb-try   installs, upgrades, removes and purges it in a Debian in a folder (as root)
# make image  the OCI image of Debian 13, into build/image (as root; make image-deps)
# make image-try   starts the image with compose.yaml and a simulated sensor (as root)
# make wheels   sdist and wheels, into build/dist (x86-64, aarch64, armv7, pure Python); make wheels-deps: what it needs
# make test-wheels  installs and runs these wheels on every supported Python that is here
# make lab-debian   boots Debian 12 and 13 with systemd and checks the package there (as root; tests/lab_debian/README.md)
# make lab-debian-suite   the whole test suite on the own Python, compiler and broker of Debian 13
# make lab-arm64    the same short on emulated arm64, and unit tests on its Python
# make attack hostile clients beside a 1 kHz device (ARGS=--short: 70 s; ARGS="--scheduling unit")
SHELL := /bin/sh
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
ARGS ?=
PROCESSES ?= 4
LAB_OPTIONS ?= --steady
RIG_OPTIONS ?=
CHAOS_OPTIONS ?= --steady --limit 14400

.PHONY: all demo test lint check bench bench-instructions bench-deps bench-compare attack soak pictures fuzz fuzz-deps clean lab lab-deps chaos audit deb deb-deps deb-try monitoring-deps lab-debian lab-debian-deps lab-debian-suite lab-arm64 lab-arm64-deps

all: check

PIP := $(BIN)/pip --disable-pip-version-check

# Both stamps depend on pyproject.toml: a change of the dependencies installs them again.
$(VENV)/made-runtime: pyproject.toml
	@echo "Installing imud and its libraries into $(VENV)"
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --editable .
	@touch $@

$(VENV)/made: $(VENV)/made-runtime
	@echo "Installing the tools of the tests into $(VENV), about 700 MB"
	$(PIP) install --editable '.[dev]'
	@touch $@

# The optional kernel in C, and the optional uPlot. Without a compiler, imud uses only its Python code. Without npm, `imud
# web` shows no plots.
KERNEL := imud/_kernel.abi3.so
$(KERNEL): imud/_kernel.c hatch_build.py packaging/web/package-lock.json $(VENV)/made-runtime
	-$(BIN)/python hatch_build.py

demo: $(VENV)/made-runtime $(KERNEL)
	$(BIN)/imud demo $(ARGS)

# Most `live` tests wait for a process, so that four processes use two cores. One folder: ARGS=tests/links PROCESSES=0
test: $(VENV)/made $(KERNEL)
	$(BIN)/pytest -n $(PROCESSES) --dist worksteal -m "not thorough" $(ARGS)

# Every test in the repository and the long form of every check, about four hours. As root, with the packages of all `-deps`.
.PHONY: test-thorough
test-thorough: lint
	IMUD_ALERTS=1 $(BIN)/pytest -n $(PROCESSES) --dist worksteal --hypothesis-profile thorough --timeout 1800
	.ci/test-pythons
	$(MAKE) wheels
	.ci/test-wheels
	$(MAKE) fuzz
	$(MAKE) mutants
	$(MAKE) bench-instructions
	$(MAKE) attack
	$(MAKE) lab
	$(MAKE) chaos ARGS="--seconds 1000"
	$(MAKE) soak
	$(MAKE) lab-debian
	$(MAKE) lab-arm64

# 120 small changes to imud, and which of them the tests detect (ARGS="--seed 7 --only imud/device")
.PHONY: mutants
mutants: $(VENV)/made
	$(BIN)/python -m tests.mutants $(ARGS)

.PHONY: alerts
alerts: $(VENV)/made
	IMUD_ALERTS=1 $(BIN)/pytest -s tests/monitoring/test_alerts.py tests/monitoring/test_fleet_alerts.py $(ARGS)

# PYTHONS="3.12 3.13" takes only these.
.PHONY: test-pythons
test-pythons:
	.ci/test-pythons $(ARGS)

lint: $(VENV)/made
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

check: lint test

bench: $(VENV)/made $(KERNEL)
	$(BIN)/python -m tests.bench $(ARGS)

bench-instructions: $(VENV)/made $(KERNEL)
	$(BIN)/python -m tests.bench.instructions $(ARGS)

# BASE=COMMIT ARGS="clock_table latency": both checkouts in turns
bench-compare: $(VENV)/made
	$(BIN)/python -m tests.bench.compare --base $(BASE) $(ARGS)

# valgrind, which counts instructions; gpsd, which imud is compared with
bench-deps:
	apt-get install --yes --no-install-recommends valgrind gpsd

.PHONY: report
report: $(VENV)/made $(KERNEL)
	$(BIN)/python -m docs.generate.report $(ARGS)

audit: $(VENV)/made
	$(BIN)/python -m tests.audit

attack: $(VENV)/made
	$(BIN)/python -m tests.attack $(ARGS)

.PHONY: fleet-demo fleet-faults fleet-load fleet-collectors fleet-scale fleet-retention fleet-jetstream
fleet-demo: $(VENV)/made
	$(BIN)/python -m tests.fleet.demo $(ARGS)

fleet-faults: $(VENV)/made
	$(BIN)/python -m tests.bench.fleet_faults $(ARGS)

fleet-load: $(VENV)/made
	$(BIN)/python -m tests.bench.fleet_load $(ARGS)

fleet-collectors: $(VENV)/made
	$(BIN)/python -m tests.bench.fleet_collectors $(ARGS)

fleet-scale: $(VENV)/made
	$(BIN)/python -m tests.bench.fleet_scale $(ARGS)

fleet-retention: $(VENV)/made
	$(BIN)/python -m tests.bench.fleet_retention $(ARGS)

fleet-jetstream: $(VENV)/made
	$(BIN)/python -m tests.bench.fleet_jetstream $(ARGS)

soak: $(VENV)/made
	$(BIN)/python -m tests.bench.soak $(ARGS)

pictures: $(VENV)/made
	$(BIN)/python -m docs.generate.pictures
	$(BIN)/python -m docs.generate.terminal_pictures
	$(BIN)/python -m docs.generate.analysis_pictures

$(VENV)/made-docs: $(VENV)/made-runtime
	@echo "Installing Sphinx into $(VENV), about 50 MB"
	$(PIP) install --quiet --editable '.[docs]'
	@touch $@

.PHONY: docs-site
docs-site: $(VENV)/made-docs
	$(BIN)/python -m docs.generate.site

# Coverage-guided fuzzing: ARGS="--seconds 60 --seed 25" in CI, ARGS="--seconds 3600 --target stream/" by hand.
$(VENV)/made-fuzz: $(VENV)/made
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[dev,fuzz]' || echo "atheris cannot be installed"
	@touch $@

fuzz: $(VENV)/made-fuzz
	$(BIN)/python -m tests.fuzz $(ARGS)

# tests of the kernel in C with AddressSanitizer and UndefinedBehaviorSanitizer
.PHONY: sanitize
sanitize: $(VENV)/made
	$(BIN)/python -m tests.fuzz.kernel $(ARGS)

# the compiler for the fuzzer of imud.h and for the sanitizers
fuzz-deps:
	apt-get install --yes --no-install-recommends clang libclang-rt-14-dev

deb: $(VENV)/made
	PYTHON=$(BIN)/python packaging/debian/build $(RELEASE) $(ARCH)

deb-try: deb
	packaging/debian/try "$$(ls -t build/deb/*.deb | head -n 1)"

# PACKAGE: a package of trixie that is already built
.PHONY: image image-try image-deps
image: $(VENV)/made
	PYTHON=$(BIN)/python packaging/image/build $(PACKAGE)

image-try: image
	$(PIP) install --quiet podman-compose
	PYTHON=$(BIN)/python packaging/image/try

image-deps: deb-deps
	apt-get install --yes --no-install-recommends umoci binutils podman runc
# variables of the environment: APT_KEY, APT_URL, RELEASES, ARCHES (packaging/apt/build)
.PHONY: apt-repository apt-try
apt-repository: $(VENV)/made
	PYTHON=$(BIN)/python packaging/apt/build

apt-try: deb
	packaging/apt/try "$$(ls -t build/deb/*.deb | head -n 1)"

deb-deps:
	apt-get install --yes --no-install-recommends debhelper lintian mmdebstrap apt-utils gnupg

.PHONY: wheels wheels-deps test-wheels
wheels: $(VENV)/made
	PYTHON=$(BIN)/python packaging/wheels

test-wheels:
	.ci/test-wheels

# compilers and emulators for the other architectures
wheels-deps:
	apt-get install --yes --no-install-recommends gcc libc6-dev gcc-aarch64-linux-gnu libc6-dev-arm64-cross \
		gcc-arm-linux-gnueabihf libc6-dev-armhf-cross qemu-user-static

# a browser for the tests of `imud web`
.PHONY: web-deps web-pictures
web-deps:
	apt-get install --yes --no-install-recommends chromium chromium-driver

web-pictures: $(VENV)/made
	$(BIN)/python -m docs.generate.web_pictures

# Signal K server, 215 MB. Another package provides its data connections (streams), which the tests do not use.
.PHONY: signalk-deps
signalk-deps:
	mkdir -p build/signalk
	cp tests/publishers/signalk/package.json build/signalk/
	npm install --prefix build/signalk --prefer-offline --no-audit --no-fund --ignore-scripts --omit=optional --loglevel=error

monitoring-deps:
	apt-get install --yes --no-install-recommends prometheus prometheus-alertmanager

.PHONY: mqtt-deps fleet-deps
mqtt-deps:
	apt-get install --yes --no-install-recommends mosquitto openssl nats-server

.PHONY: influx-deps
influx-deps:
	apt-get install --yes --no-install-recommends influxdb

fleet-deps: mqtt-deps influx-deps
	apt-get install --yes --no-install-recommends postgresql

# Fast DDS, the default of ROS 2, as a reader of the output `ros2`
.PHONY: ros2-deps
ros2-deps:
	apt-get install --yes --no-install-recommends libfastrtps-dev g++

lab-deps:
	tests/lab/deps

lab: $(VENV)/made
	tests/lab/run $(LAB_OPTIONS) -- $(ARGS)

chaos: $(VENV)/made
	tests/lab/run $(CHAOS_OPTIONS) --exec '$(BIN)/python -m tests.lab.chaos $(ARGS)'

# As root; RIG_OPTIONS="--suite trixie" ARGS=replug: one release, one group of checks.
lab-debian: $(VENV)/made
	tests/lab_debian/run $(RIG_OPTIONS) $(ARGS)

# As root; ARGS="bookworm tests/sampling": another release, some of the tests.
lab-debian-suite:
	tests/lab_debian/suite $(ARGS)

lab-debian-deps: deb-deps
	tests/lab_debian/deps amd64

# As root; ARGS=unit-tests: these only, without a machine.
lab-arm64: $(VENV)/made
	tests/lab_debian/run --arm64 $(RIG_OPTIONS) $(ARGS)

lab-arm64-deps: deb-deps
	tests/lab_debian/deps arm64

clean:
	rm -rf build $(VENV) .mypy_cache .ruff_cache .pytest_cache .hypothesis
