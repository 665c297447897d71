#!/bin/sh
# Install imud-daemon on Debian (@RELEASES@; @ARCHES@) from its apt repository, which stays for upgrades:
#     curl -fsSL @URL@/install.sh | sudo sh
set -eu

die() { echo "install.sh: $*; nothing was changed" >&2; exit 1; }

# A function: an incomplete download runs nothing.
main() {
    [ "$(id -u)" = 0 ] || die "expected root, got user $(id -un); try curl -fsSL @URL@/install.sh | sudo sh"
    command -v apt-get >/dev/null && command -v dpkg >/dev/null || die "expected Debian with apt, cannot find apt-get"
    release=$(. /etc/os-release && echo "${VERSION_CODENAME:-}")
    arch=$(dpkg --print-architecture)
    case " @RELEASES@ " in
        *" ${release:-none} "*) ;;
        *) die "expected the Debian release @RELEASES@, got '$release'; use pip instead (page Installation of imud)" ;;
    esac
    case " @ARCHES@ " in
        *" $arch "*) ;;
        *) die "expected the architecture @ARCHES@, got $arch; use pip instead (page Installation of imud)" ;;
    esac
    # Raspberry Pi OS for these boards has the same name of the architecture.
    [ "$(uname -m)" != armv6l ] || die "expected ARMv7 or later, got ARMv6 (Raspberry Pi 1 or Zero)"

    mkdir -p /etc/apt/keyrings
    key >/etc/apt/keyrings/imud-archive-keyring.asc
    cat >/etc/apt/sources.list.d/imud.sources <<END
Types: deb
URIs: @URL@
Suites: $release
Components: main
Architectures: $arch
Signed-By: /etc/apt/keyrings/imud-archive-keyring.asc
END
    chmod 644 /etc/apt/keyrings/imud-archive-keyring.asc /etc/apt/sources.list.d/imud.sources
    # --no-remove: another project has a package with the same files.
    apt-get --quiet update </dev/null
    apt-get --quiet install --yes --no-remove imud-daemon </dev/null
    imud --version
}

key() {
    cat <<'END'
@KEY@
END
}

main
