"""Creates the image for QEMU once per change of its inputs: a disk with Debian, its kernel, an initramfs.

Packages come from the archives of apt on the host. Only the maintainer scripts of Debian run in a chroot. With
qemu-user, maintainer scripts of another architecture took more than 40 minutes. Therefore the system is set up for the
architecture of the host, and then programs, libraries and the records of dpkg are exchanged. The kernel package is only
unpacked. This module creates the initramfs, because initramfs-tools takes minutes in emulation. Needs root.
"""

import gzip
import lzma
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from tests.lab.host import cache
from tests.lab.host.errors import LabError
from tests.lab_debian.host import release as release_module
from tests.lab_debian.host.release import BOOT_MODULES, MODULES, SYSTEM, Release

ROOT_FILES = Path(__file__).resolve().parents[1] / "root"
DISK = "disk.ext4"
KERNEL = "kernel"
INITRAMFS = "initramfs.gz"
DISK_BYTES = 2 << 30
"""Size of the sparse disk file, bytes. Writes of the guest go to another file (`snapshot=on`)."""
NEEDED_BYTES = 3 << 30  # free space for a build of an image
STEP_LIMIT_S = 40 * 60  # limit of one step on a busy host
CLEAN = {"PATH": "/usr/sbin:/usr/bin:/sbin:/bin", "HOME": "/root", "LC_ALL": "C"}
"""Environment of every step, without the host's settings of pip and apt."""
BINFMT = Path("/proc/sys/fs/binfmt_misc")
HOST = "amd64"
TRIPLETS = {"amd64": "x86_64-linux-gnu", "arm64": "aarch64-linux-gnu"}
FOREIGN = {"arm64": "qemu-aarch64"}
"""Foreign architectures, with the names of their emulation in the host's kernel."""

MASKED = (
    *("serial-getty@.service", "getty@.service", "getty-static.service", "console-getty.service"),
    *("apt-daily.timer", "apt-daily-upgrade.timer", "dpkg-db-backup.timer", "fstrim.timer", "e2scrub_all.timer"),
    *("e2scrub_reap.service", "systemd-binfmt.service", "proc-sys-fs-binfmt_misc.automount"),
    *(
        "gpsd.service", "gpsd.socket", "chrony.service", "systemd-pcrphase.service",
        "systemd-networkd-wait-online.service",
    ),
)  # fmt: skip
"""Units that slow down an emulated system or disturb the checks. The checks start their own gpsd and chronyd."""

INIT = """\
#!/bin/busybox sh
/bin/busybox mount -t devtmpfs dev /dev
/bin/busybox mount -t proc proc /proc
for module in /modules/*; do /bin/busybox insmod $module || echo "lab init failed: $module cannot be loaded"; done
while [ ! -e /dev/vda ]; do /bin/busybox usleep 20000; done
/bin/busybox mount -t ext4 -o rw,noatime /dev/vda /new || echo "lab init failed: /dev/vda cannot be mounted"
/bin/busybox umount /proc
/bin/busybox mount --move /dev /new/dev
exec /bin/busybox switch_root /new /lib/systemd/systemd
"""


@dataclass(frozen=True)
class Image:
    disk: Path
    kernel: Path
    initramfs: Path


def built(release: Release, say: Callable[[str], None]) -> Image:
    def make(folder: Path) -> None:
        say(f"{release.name}: building the image (some minutes, once)")
        make_image(release, folder)

    folder = cache.get(f"debian-{release.name}-{key(release)}", make, NEEDED_BYTES, say, cache.cache_root("-debian"))
    return Image(folder / DISK, folder / KERNEL, folder / INITRAMFS)


def key(release: Release) -> str:
    files = sorted(path for path in ROOT_FILES.rglob("*") if path.is_file())
    parts = [part for path in files for part in (str(path.relative_to(ROOT_FILES)).encode(), path.read_bytes())]
    recipe = [Path(path).read_bytes() for path in (__file__, release_module.__file__)]
    return cache.key_of(release.name.encode(), *recipe, *parts)


def make_image(release: Release, folder: Path) -> None:
    root, tree, log = folder / "root", folder / "tree", folder / "build.log"
    try:
        bootstrap(replace(release, architecture=HOST), root, log, "minbase", SYSTEM)
        if release.foreign:
            exchange(release, root, folder / "exchanged", log)
        bootstrap(release, tree, log, "extract", (f"linux-image-{release.architecture}", "busybox-static"))
        if not (tree / "lib").exists():
            (tree / "lib").symlink_to("usr/lib")  # trixie's kernel package has its modules there
        kernel = next((tree / "boot").glob("vmlinuz-*"))
        version = kernel.name.removeprefix("vmlinuz-")
        step(["depmod", "--basedir", str(tree), version], log)
        shutil.copy(kernel, folder / KERNEL)
        write_initramfs(tree, version, folder / "early", folder / INITRAMFS, log)
        copy_modules(tree, version, root, log)
        prepare_root(root)
        make_disk(root, folder / DISK, log)
    finally:
        for part in (root, tree, folder / "early", folder / "exchanged"):
            shutil.rmtree(part, ignore_errors=True)


def exchange(release: Release, root: Path, other: Path, log: Path) -> None:
    """Copy the programs of the release's architecture into a root file system that is set up for the host.

    The results of maintainer scripts (users, links, enabled units, bytecode) are the same on both.
    """
    query = ["dpkg-query", f"--admindir={root}/var/lib/dpkg", "--show", "--showformat=${Package}\n"]
    names = subprocess.run(query, capture_output=True, text=True, check=False).stdout.split()
    bootstrap(release, other, log, "extract", tuple(names))
    ours, theirs = TRIPLETS[HOST], TRIPLETS[release.architecture]
    for folder in (root / f"usr/lib/{ours}", root / "usr/lib64", root / "var/cache/ldconfig"):
        shutil.rmtree(folder, ignore_errors=True)
    for name in ("var", "run", "dev"):
        shutil.rmtree(other / name, ignore_errors=True)  # the target contains these folders, some of them as links
    for name in ("lib64", "etc/ld.so.cache", f"etc/ld.so.conf.d/{ours}.conf"):
        (root / name).unlink(missing_ok=True)
    step(["cp", "--archive", "--remove-destination", f"{other}/.", str(root)], log)
    records = root / "var/lib/dpkg"
    for file in records.glob(f"info/*:{HOST}.*"):
        file.rename(file.with_name(file.name.replace(f":{HOST}.", f":{release.architecture}.")))
    for file in (records / "status", *records.glob("info/*.list")):
        text = file.read_text(encoding="utf-8").replace(f"/{ours}", f"/{theirs}")
        file.write_text(text.replace(f"Architecture: {HOST}\n", f"Architecture: {release.architecture}\n"), "utf-8")


def enable_emulation(architecture: str) -> None:
    name = FOREIGN.get(architecture)
    if not name or (BINFMT / name).exists():
        return
    mount = [] if BINFMT.is_mount() else [["mount", "-t", "binfmt_misc", "binfmt_misc", str(BINFMT)]]
    for command in (*mount, ["update-binfmts", "--enable", name]):
        result = subprocess.run(command, capture_output=True, text=True, check=False, env=CLEAN)
        if result.returncode:
            raise LabError(f"cannot run programs for {architecture}: {command[0]}: {result.stderr.strip()}")


def bootstrap(release: Release, folder: Path, log: Path, variant: str, packages: tuple[str, ...]) -> None:
    """Install `packages` with their dependencies into `folder` with mmdebstrap."""
    main, security = archives()
    suites = ((main, release.suite), (main, f"{release.suite}-updates"), (security, f"{release.suite}-security"))
    sources = "".join(f"deb {uri} {suite} main\n" for uri, suite in suites)
    command = [
        *("mmdebstrap", "--verbose", "--mode=root", f"--variant={variant}", f"--architectures={release.architecture}"),
        *(f"--include={','.join(packages)}", '--aptopt=Acquire::Languages "none"'),
        *('--aptopt=APT::Install-Recommends "false"', '--aptopt=Acquire::Check-Valid-Until "false"'),
        "--dpkgopt=force-unsafe-io",  # safe: an interrupted image is deleted
        *(f"--dpkgopt=path-exclude=/usr/share/{part}/*" for part in ("man", "doc", "locale")),
        *(release.suite, str(folder), "-"),
    ]
    step(command, log, sources)


def archives() -> tuple[str, str]:
    """Return the URIs of Debian's archive and of its security updates in the configuration of apt. Raises LabError
    without them."""
    query = ["apt-get", "indextargets", "--format", "$(CODENAME) $(REPO_URI)", "Created-By: Packages", "Origin: Debian"]
    rows = subprocess.run(query, capture_output=True, text=True, check=False).stdout.splitlines()
    uris = dict(row.split(" ", 1) for row in reversed(rows))
    main = next((uri for name, uri in uris.items() if "-" not in name), "")
    security = next((uri for name, uri in uris.items() if name.endswith("-security")), "")
    if not main or not security:
        raise LabError(
            "cannot find Debian's archive and its security updates in the configuration of apt; try apt-get update"
        )
    return main, security


def write_initramfs(tree: Path, version: str, work: Path, out: Path, log: Path) -> None:
    """Write an initramfs that loads BOOT_MODULES, mounts /dev/vda and starts its systemd."""
    for name in ("bin", "dev", "proc", "new", "modules"):
        (work / name).mkdir(parents=True)
    busybox = next(path for path in (tree / "bin/busybox", tree / "usr/bin/busybox") if path.exists())
    shutil.copy(busybox, work / "bin/busybox")
    for number, module in enumerate(files_of(tree, version, BOOT_MODULES)):
        (work / "modules" / f"{number:03}.ko").write_bytes(unpacked(module))
    (work / "init").write_text(INIT, encoding="ascii")
    (work / "init").chmod(0o755)
    names = "\n".join(["."] + [str(path.relative_to(work)) for path in sorted(work.rglob("*"))])
    archive = work.with_suffix(".cpio")
    step(["cpio", "--quiet", "--create", "--format=newc", "--owner=0:0", f"--file={archive}"], log, names, work)
    out.write_bytes(gzip.compress(archive.read_bytes(), 1))
    archive.unlink()


def files_of(tree: Path, version: str, modules: tuple[str, ...]) -> list[Path]:
    """Return the files of the modules and their dependencies, in the order of loading, without built-in modules."""
    found: list[Path] = []
    for name in modules:
        query = ["modprobe", "--dirname", str(tree), "--set-version", version, "--show-depends", name]
        listing = subprocess.run(query, capture_output=True, text=True, check=False, env=CLEAN).stdout
        paths = [Path(line.split()[1]) for line in listing.splitlines() if line.startswith("insmod ")]
        found += [path for path in paths if path not in found]
    return found


def unpacked(module: Path) -> bytes:
    """Return a module's bytes, uncompressed. trixie compresses modules."""
    return lzma.decompress(module.read_bytes()) if module.suffix == ".xz" else module.read_bytes()


def copy_modules(tree: Path, version: str, root: Path, log: Path) -> None:
    """Copy MODULES and BOOT_MODULES with their dependencies into the root file system."""
    source = tree / "lib/modules" / version
    target = root / "usr/lib/modules" / version
    for module in files_of(tree, version, (*BOOT_MODULES, *MODULES)):
        place = target / module.resolve().relative_to(source.resolve())
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(module, place)
    for name in ("modules.builtin", "modules.builtin.modinfo", "modules.order"):
        shutil.copy(source / name, target / name)
    step(["depmod", "--basedir", str(root), version], log)


def prepare_root(root: Path) -> None:
    """Let the root file system start the lab's program, and no unnecessary units."""
    shutil.copytree(ROOT_FILES, root, dirs_exist_ok=True, symlinks=True)
    (root / "etc/hostname").write_text("lab\n", encoding="ascii")
    (root / "etc/fstab").write_text("", encoding="ascii")
    (root / "etc/machine-id").write_text("", encoding="ascii")
    units = root / "etc/systemd/system"
    wanted = units / "multi-user.target.wants"
    wanted.mkdir(parents=True, exist_ok=True)
    (wanted / "lab.service").symlink_to("/etc/systemd/system/lab.service")
    for name in MASKED:
        (units / name).unlink(missing_ok=True)
        (units / name).symlink_to("/dev/null")


def make_disk(root: Path, disk: Path, log: Path) -> None:
    with open(disk, "wb") as file:
        file.truncate(DISK_BYTES)
    options = ["-t", "ext4", "-O", "^has_journal", "-E", "lazy_itable_init=1,root_owner=0:0"]
    step(["mke2fs", "-q", *options, "-d", str(root), str(disk)], log)


def step(command: list[str], log: Path, text: str = "", folder: Path | None = None) -> None:
    """Run one step at low priority with `text` as its input and its output in `log`. LabError quotes the last line."""
    with open(log, "ab") as out:
        out.write(f"+ {' '.join(command)}\n".encode())
        out.flush()
        try:
            status = subprocess.run(
                ["nice", "-n", "5", *command],
                input=text.encode(), stdout=out, stderr=out, env=CLEAN, cwd=folder, timeout=STEP_LIMIT_S, check=False
            ).returncode  # fmt: skip
        except subprocess.TimeoutExpired as error:
            raise LabError(f"expected the end of {command[0]} within {STEP_LIMIT_S} s") from error
    if status:
        lines = [line for line in log.read_text("utf-8", "replace").splitlines() if line.strip()]
        raise LabError(f"{command[0]} failed: {lines[-1]}")
