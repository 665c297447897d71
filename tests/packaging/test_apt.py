"""The signed apt repository with small packages and a throw-away key, read by the apt of this host without root."""

import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.support.daemon_process import LIMIT_S
from tests.support.files import ROOT

TOOLS = ("apt-get", "apt-ftparchive", "dpkg-deb", "gpg")
MISSING = [name for name in TOOLS if shutil.which(name) is None]
pytestmark = [
    pytest.mark.live,
    pytest.mark.timeout(300),
    pytest.mark.skipif(bool(MISSING), reason=f"cannot find {' '.join(MISSING)}; try make deb-deps"),
]

APT = ROOT / "packaging" / "apt"
URL = "https://example.org/imud"
Done = subprocess.CompletedProcess[str]


def run(argv: list[str], **environment: str) -> Done:
    environment = {**os.environ, "LC_ALL": "C", **environment}
    return subprocess.run(argv, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT_S)


def new_key(home: str) -> str:
    """Create a key and return its fingerprint."""
    make = ["gpg", "--batch", "--passphrase", "", "--quick-generate-key", "nobody", "ed25519", "sign", "never"]
    assert run(make, GNUPGHOME=home).returncode == 0
    listed = run(["gpg", "--batch", "--with-colons", "--list-secret-keys"], GNUPGHOME=home).stdout
    return str(re.findall(r"^fpr:+(\w+):", listed, re.MULTILINE)[-1])


@pytest.fixture(scope="module")
def signing() -> Iterator[dict[str, str]]:
    """Environment of `repository`. The path of a socket of gpg must be short."""
    with tempfile.TemporaryDirectory(prefix="imud-gpg-") as home:
        yield {"GNUPGHOME": home, "APT_KEY": new_key(home), "APT_URL": URL}
        run(["gpgconf", "--kill", "all"], GNUPGHOME=home)


@pytest.fixture(scope="module")
def arch() -> str:
    return run(["dpkg", "--print-architecture"]).stdout.strip()


def package(folder: Path, version: str, arch: str, content: str = "") -> str:
    """Build a package with one file, /usr/share/imud-version, and return its path."""
    tree = folder / f"{version}-{arch}-{len(content)}"
    (tree / "DEBIAN").mkdir(parents=True)
    (tree / "usr/share").mkdir(parents=True)
    (tree / "usr/share/imud-version").write_text(version + content)
    fields = f"Package: imud-daemon\nVersion: {version}\nArchitecture: {arch}\nMaintainer: a <a@localhost>\n"
    (tree / "DEBIAN/control").write_text(fields + "Description: test\n")
    done = run(["dpkg-deb", "--root-owner-group", "--build", str(tree), f"{tree}.deb"])
    assert done.returncode == 0, done.stderr
    return f"{tree}.deb"


def repository(folder: Path, *packages: str, **environment: str) -> Done:
    return run([str(APT / "repository"), str(folder), *packages], **environment)


@pytest.fixture
def apt(tmp_path: Path, arch: str) -> Callable[..., Done]:
    """Return a function that runs apt-get on a system below tmp_path that uses the repository tmp_path/apt."""
    root = tmp_path / "system"
    for name in (
        "etc/apt",
        "var/lib/apt/lists/partial",
        "var/cache/apt/archives/partial",
        "var/lib/dpkg",
        "var/log/apt",
    ):
        (root / name).mkdir(parents=True)
    (root / "var/lib/dpkg/status").touch()
    options = {
        "Dir": root, "Dir::State::status": root / "var/lib/dpkg/status", "APT::Architecture": arch,
        "APT::Architectures": arch, "APT::Sandbox::User": "root", "Acquire::Languages": "none",
        "Debug::NoLocking": "1", "DPkg::Options::": f"--root={root}", "DPkg::options::": "--force-not-root",
    }  # fmt: skip
    argv = ["apt-get", "--quiet", "--yes", *(word for one in options.items() for word in ("-o", f"{one[0]}={one[1]}"))]

    def call(*words: str, release: str = "bookworm", keyring: Path = tmp_path / "apt/imud-archive-keyring.asc") -> Done:
        source = f"deb [signed-by={keyring}] file:{tmp_path}/apt {release} main\n"
        (root / "etc/apt/sources.list").write_text(source)
        path = f"{os.environ['PATH']}:/usr/sbin:/sbin"
        return subprocess.run(
            [*argv, *words], env={**os.environ, "LC_ALL": "C", "PATH": path, "DPKG_ROOT": ""}, cwd=root,
            capture_output=True, text=True, check=False, timeout=LIMIT_S,
        )  # fmt: skip

    return call


def test_scripts_are_shell() -> None:
    for name in ("build", "repository", "try"):
        assert os.access(APT / name, os.X_OK)
        subprocess.run(["bash", "-n", str(APT / name)], check=True, timeout=LIMIT_S)
    subprocess.run(["sh", "-n", str(APT / "install.sh")], check=True, timeout=LIMIT_S)


def test_apt_installs_and_upgrades_through_the_repository(
    tmp_path: Path, signing: dict[str, str], arch: str, apt: Callable[..., Done]
) -> None:
    first = [package(tmp_path, f"0.1-1~{one}", arch) for one in ("bookworm", "trixie")]
    done = repository(tmp_path / "apt", *first, package(tmp_path, "0.1-1~bookworm", "s390x"), **signing)
    assert done.returncode == 0, done.stderr
    assert re.findall(r"^(\w+) +(\w+) .*  (\S+)$", done.stdout, re.MULTILINE) == [
        *sorted([("bookworm", arch, "0.1-1~bookworm"), ("bookworm", "s390x", "0.1-1~bookworm")]),
        ("trixie", arch, "0.1-1~trixie"),
    ]
    release = (tmp_path / "apt/dists/bookworm/Release").read_text()
    for line in ("Origin: imud", "Suite: bookworm", "Codename: bookworm", "Components: main", "Acquire-By-Hash: yes"):
        assert f"{line}\n" in release
    assert f"Architectures: {' '.join(sorted([arch, 's390x']))}\n" in release
    assert "Valid-Until" not in release

    installed = tmp_path / "system/usr/share/imud-version"
    assert (done := apt("update", "--error-on=any")).returncode == 0, done.stderr
    assert (done := apt("install", "imud-daemon")).returncode == 0, done.stderr
    assert installed.read_text() == "0.1-1~bookworm"
    lists = set((tmp_path / "apt/dists/bookworm/main").rglob("by-hash/SHA256/*"))
    done = repository(tmp_path / "apt", package(tmp_path, "0.2-1~bookworm", arch), **signing)
    assert done.returncode == 0, done.stderr
    assert lists < set((tmp_path / "apt/dists/bookworm/main").rglob("by-hash/SHA256/*")), "of hosts in an update"
    assert (done := apt("update", "--error-on=any")).returncode == 0, done.stderr
    assert (done := apt("install", "--only-upgrade", "imud-daemon")).returncode == 0, done.stderr
    assert installed.read_text() == "0.2-1~bookworm"
    assert (done := apt("install", "--allow-downgrades", "imud-daemon=0.1-1~bookworm")).returncode == 0, done.stderr
    assert installed.read_text() == "0.1-1~bookworm", "earlier versions stay"


def change(file: Path, old: bytes, new: bytes) -> None:
    data = file.read_bytes()
    assert data.count(old) >= 1
    file.write_bytes(data.replace(old, new))


def test_apt_rejects_a_change_of_each_file(
    tmp_path: Path, signing: dict[str, str], arch: str, apt: Callable[..., Done]
) -> None:
    folder = tmp_path / "apt"
    done = repository(folder, package(tmp_path, "0.1-1~bookworm", arch), **signing)
    assert done.returncode == 0, done.stderr
    shutil.copytree(folder, tmp_path / "good")
    with tempfile.TemporaryDirectory(prefix="imud-gpg-") as home:
        other = tmp_path / "other.asc"
        other.write_text(run(["gpg", "--armor", "--export", new_key(home)], GNUPGHOME=home).stdout)
        run(["gpgconf", "--kill", "all"], GNUPGHOME=home)

    def restored() -> None:
        shutil.rmtree(folder)
        shutil.copytree(tmp_path / "good", folder)
        shutil.rmtree(tmp_path / "system/var/lib/apt/lists")
        (tmp_path / "system/var/lib/apt/lists/partial").mkdir(parents=True)
        assert apt("update", "--error-on=any").returncode == 0

    dist = folder / "dists/bookworm"
    restored()
    assert apt("download", "imud-daemon").returncode == 0
    (tmp_path / f"system/imud-daemon_0.1-1~bookworm_{arch}.deb").unlink()
    (pool,) = folder.glob("pool/bookworm/*.deb")
    pool.write_bytes(pool.read_bytes()[:-1] + b"X")
    done = apt("download", "imud-daemon")
    assert (done.returncode, "Hash Sum mismatch" in done.stderr) == (100, True), done.stderr

    restored()
    for file in dist.rglob("*"):  # the same size: apt finds this only with the checksum
        if file.name == "Packages" or (file.parent.name == "SHA256" and file.read_bytes().startswith(b"Package:")):
            change(file, b"Version: 0.1", b"Version: 9.1")
        elif file.name == "Packages.gz" or file.parent.name == "SHA256":
            file.unlink()
    shutil.rmtree(tmp_path / "system/var/lib/apt/lists")
    (tmp_path / "system/var/lib/apt/lists/partial").mkdir(parents=True)
    done = apt("update", "--error-on=any")
    assert (done.returncode, "Hash Sum mismatch" in done.stderr) == (100, True), done.stderr

    restored()
    change(dist / "InRelease", b"Suite: bookworm", b"Suite: bookwork")
    done = apt("update", "--error-on=any")
    assert (done.returncode, "signature" in done.stderr.lower()) == (100, True), done.stderr
    (dist / "InRelease").unlink()
    change(dist / "Release", b"Suite: bookworm", b"Suite: bookwork")
    done = apt("update", "--error-on=any")
    assert (done.returncode, "signature" in done.stderr.lower()) == (100, True), done.stderr

    restored()
    done = apt("update", "--error-on=any", keyring=other)
    assert (done.returncode, "not signed" in done.stderr or "NO_PUBKEY" in done.stderr) == (100, True), done.stderr


def test_repository_refuses_unusable_input(tmp_path: Path, signing: dict[str, str], arch: str) -> None:
    one = package(tmp_path, "0.1-1~bookworm", arch)
    for wrong, said in [
        ({"APT_URL": ""}, "APT_URL"), ({"APT_URL": "example.org"}, "APT_URL"), ({"APT_URL": URL + "/|x"}, "APT_URL"),
        ({"APT_KEY": ""}, "gpg --quick-generate-key"), ({"APT_KEY": "0" * 40}, f"APT_KEY, got '{'0' * 40}'"),
        ({"APT_KEY": signing["APT_KEY"][-16:]}, "expected the fingerprint"),
    ]:  # fmt: skip
        done = repository(tmp_path / "apt", one, **{**signing, **wrong})
        assert (done.returncode, said in done.stderr) == (1, True), done.stderr
        assert run([str(APT / "build")], **{**signing, **wrong}).returncode == 1, "before the builds"
    done = repository(tmp_path / "apt", package(tmp_path, "0.1-1~sid", arch), **signing)
    assert (done.returncode, "ends in ~bookworm or ~trixie, got 0.1-1~sid" in done.stderr) == (1, True), done.stderr
    assert not list((tmp_path / "apt").iterdir())
    assert repository(tmp_path / "apt", one, **signing).returncode == 0
    assert repository(tmp_path / "apt", one, **signing).returncode == 0
    done = repository(tmp_path / "apt", package(tmp_path, "0.1-1~bookworm", arch, "other"), **signing)
    assert (done.returncode, "a published version never changes" in done.stderr) == (1, True), done.stderr


def test_install_script_checks_the_host_before_it_changes_it(
    tmp_path: Path, signing: dict[str, str], arch: str
) -> None:
    done = repository(tmp_path / "apt", package(tmp_path, "0.1-1~bookworm", arch), **signing)
    assert done.returncode == 0, done.stderr
    text = (tmp_path / "apt/install.sh").read_text()
    assert not re.search(r"@[A-Z]+@", text)
    etc, stubs = tmp_path / "etc", tmp_path / "bin"
    stubs.mkdir()
    answers = {"id": "echo ${IMUD_UID:-0}", "dpkg": f"echo ${{IMUD_ARCH:-{arch}}}", "uname": "echo ${IMUD_CPU:-x}"}
    for name, body in {**answers, "imud": "echo imud 0.1", "apt-get": f'echo "$@" >>{tmp_path}/calls'}.items():
        (stubs / name).write_text(f"#!/bin/sh\n{body}\n")
        (stubs / name).chmod(0o755)

    def install(script: str, release: str = "bookworm", **environment: str) -> Done:
        shutil.rmtree(etc, ignore_errors=True)
        (etc / "apt/sources.list.d").mkdir(parents=True)
        (etc / "os-release").write_text(f"VERSION_CODENAME={release}\n")
        (tmp_path / "calls").write_text("")
        moved = re.sub(r"(?<![\w/.])/etc/(?!apt/keyrings/imud-archive-keyring.asc\nEND)", f"{etc}/", script)
        return run(["sh", "-c", moved], PATH=f"{stubs}:{os.environ['PATH']}", **environment)

    def is_unchanged() -> bool:
        return not (tmp_path / "calls").read_text() and not [one for one in etc.rglob("*imud*") if one.is_file()]

    for host, said in [
        ({"release": "noble"}, "expected the Debian release bookworm, got 'noble'"),
        ({"release": ""}, "expected the Debian release bookworm, got ''"),
        ({"IMUD_ARCH": "mips64el"}, f"expected the architecture {arch}, got mips64el"),
        ({"IMUD_CPU": "armv6l"}, "expected ARMv7 or later, got ARMv6"),
        ({"IMUD_UID": "1000"}, f"try curl -fsSL {URL}/install.sh | sudo sh"),
    ]:
        done = install(text, **host)
        assert (done.returncode, said in done.stderr, "nothing was changed" in done.stderr) == (1, True, True), done
        assert is_unchanged()
    for part in range(1, 20):
        install(text[: part * len(text) // 20])
        assert is_unchanged(), "after an incomplete download"
    done = install(text)
    assert (done.returncode, done.stdout) == (0, "imud 0.1\n"), done.stderr
    calls = (tmp_path / "calls").read_text()
    assert calls == "--quiet update\n--quiet install --yes --no-remove imud-daemon\n"
    key = tmp_path / "apt/imud-archive-keyring.asc"
    assert (etc / "apt/keyrings/imud-archive-keyring.asc").read_bytes() == key.read_bytes()
    assert (etc / "apt/sources.list.d/imud.sources").read_text() == (
        f"Types: deb\nURIs: {URL}\nSuites: bookworm\nComponents: main\nArchitectures: {arch}\n"
        "Signed-By: /etc/apt/keyrings/imud-archive-keyring.asc\n"
    )
