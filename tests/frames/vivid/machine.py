"""A computer with video devices: Debian's kernel and its driver vivid, in QEMU.

It boots in about four seconds of its own time, sees this computer's files and cannot change them,
and runs one Python program with this interpreter. Its clock counts executed instructions, and real
time during waits: a busy computer makes the machine slower, unnoticed by its programs. ``python -m
tests.frames.vivid.machine fetch`` downloads and unpacks the kernel; ``... run SCRIPT [ARGUMENT
...]`` runs a program there, and ``... clock run SCRIPT`` with real time.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from pathlib import Path

CACHE = Path(tempfile.gettempdir()) / "smartcam-vivid-kernel"
"""Folder of the kernel: ``vmlinuz`` and the needed modules."""

ROOT = Path(__file__).resolve().parents[3]

PACKAGES = {"qemu-system-x86_64": "qemu-system-x86", "busybox": "busybox-static"}
"""Programs, and their packages in Debian."""

BEFORE = ("virtio_pci", "9pnet_virtio", "9p")
"""Modules that are loaded before the mount of the files."""

DEVICES = "n_devs=5 node_types=0x1,0x1,0x1,0x20001,0x1 multiplanar=1,1,1,1,2"
"""Five cameras of vivid: the fourth has a metadata device, the fifth is multi-planar."""

PROGRAMS = ("sh", "mount", "mkdir", "insmod", "chroot", "poweroff", "ip")

INIT = """#!/bin/sh
mount -t proc proc /proc
mount -t sysfs sys /sys
mount -t devtmpfs dev /dev
for one in {before}; do insmod /modules/$one.ko; done
share=trans=virtio,version=9p2000.L,msize=262144
mount -t 9p -o $share,ro,cache=loose root /root
mount -t tmpfs run /root/run
mkdir /root/run/out
mount -t 9p -o $share out /root/run/out
for one in {after}; do insmod /modules/$one.ko; done
insmod /modules/vivid.ko {devices}
for one in dev proc sys; do mount -o bind /$one /root/$one; done
ip link set lo up
chroot /root /bin/sh /run/out/job
echo $? > /root/run/out/status
poweroff -f
"""


def missing() -> str | None:
    """Return the missing parts, and their origin; None: all are here."""
    for program, package in (
        ("qemu-system-x86_64", "qemu-system-x86"),
        ("busybox", "busybox-static"),
    ):
        if shutil.which(program) is None:
            return f"no {program}: Debian's {package} has it"
    if not (CACHE / "vmlinuz").exists():
        return "no kernel with vivid: python -m tests.frames.vivid.machine fetch"
    return None


def fetch() -> None:
    """Download this Debian's kernel, and keep the needed parts."""
    if (CACHE / "vmlinuz").exists():
        return
    shown = subprocess.run(
        ["apt-cache", "depends", "linux-image-amd64"],  # noqa: S607 - wherever it is
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    package = next(one for one in re.findall(r"linux-image-\S+", shown) if one[12].isdigit())
    with tempfile.TemporaryDirectory(dir=CACHE.parent) as folder:
        for command in (
            f"apt-get -qq -o APT::Sandbox::User=root download {package}",
            "dpkg -x linux-image-*.deb all",
        ):
            subprocess.run(["/bin/sh", "-c", command], check=True, cwd=folder)  # noqa: S603
        kept = Path(folder, "kept")
        kept.mkdir()
        all_modules = {simple(one.stem): one for one in Path(folder, "all").rglob("*.ko")}
        for name in with_dependencies(("vivid", *BEFORE), all_modules):
            shutil.copy(all_modules[name], kept / f"{name}.ko")
        shutil.copy(next(Path(folder, "all/boot").glob("vmlinuz-*")), kept / "vmlinuz")
        kept.rename(CACHE)


def simple(module: str) -> str:
    """Return a module's name in the kernel's form."""
    return module.replace("-", "_")


def with_dependencies(names: Iterable[str], modules: dict[str, Path]) -> list[str]:
    """Return modules and their dependencies, in the order of loading."""
    order: dict[str, None] = {}

    def visit(name: str) -> None:
        if name in order or name not in modules:  # a missing module is built in
            return
        found = re.search(rb"(?:^|\0)depends=([^\0]*)\0", modules[name].read_bytes())
        for needed in found[1].decode().split(",") if found and found[1] else ():
            visit(simple(needed))
        order[name] = None

    for name in names:
        visit(name)
    return list(order)


def archive(files: Iterable[tuple[str, int, bytes]]) -> bytes:
    """Return a cpio archive of files: name, mode, content (cpio's format newc)."""
    out = bytearray()
    for number, (name, mode, content) in enumerate([*files, ("TRAILER!!!", 0, b"")], 1):
        fields = (number, mode, 0, 0, 1, 0, len(content), 0, 0, 0, 0, len(name) + 1, 0)
        out += b"070701" + b"".join(b"%08X" % one for one in fields) + name.encode() + b"\0"
        out += bytes(-len(out) % 4) + content
        out += bytes(-len(out) % 4)
    return bytes(out)


def initial_files() -> bytes:
    """Return the first files of the kernel."""
    modules = {one.stem: one for one in CACHE.glob("*.ko")}
    before = with_dependencies(BEFORE, modules)
    after = [one for one in with_dependencies(["vivid"], modules) if one not in before]
    init = INIT.format(
        before=" ".join(before), after=" ".join(after[:-1]), devices=DEVICES
    ).encode()
    folder, program = stat.S_IFDIR | 0o755, stat.S_IFREG | 0o755
    busybox = Path(shutil.which("busybox") or "").read_bytes()
    return archive(
        [
            *((one, folder, b"") for one in ("bin", "dev", "proc", "sys", "modules", "root")),
            ("bin/busybox", program, busybox),
            *((f"bin/{one}", stat.S_IFLNK | 0o777, b"busybox") for one in PROGRAMS),
            *(
                (f"modules/{one}.ko", program, modules[one].read_bytes())
                for one in (*before, *after)
            ),
            ("init", program, init),
        ]
    )


def run(
    script: Path, arguments: Iterable[str], out: Path, *, timeout: float, counted: bool = True
) -> tuple[int, str]:
    """Run a Python program in the machine.

    Args:
        script: file of this computer.
        arguments: arguments of the program.
        out: folder that the program sees as ``/run/out``, and alone can write to.
        timeout: seconds of real time; then the machine is switched off.
        counted: whether the clock counts instructions, 2 ns each.

    Returns:
        The program's status, and the output of machine and program.
    """
    command = shlex.join([sys.executable, "-X", "faulthandler", str(script), *arguments])
    (out / "job").write_text(
        f"cd {shlex.quote(str(ROOT))}\n"
        "export PYTHONPYCACHEPREFIX=/none\n"  # its clock does not depend on compilation here
        f"export PYTHONPATH=$PWD PYTHONDONTWRITEBYTECODE=1 TMPDIR=/run HOME=/run\n{command}\n"
    )
    (out / "initial").write_bytes(initial_files())
    shared = "local,security_model=none"
    machine = [
        "qemu-system-x86_64", "-accel", "tcg", "-cpu", "max",
        *(("-icount", "shift=1") if counted else ()), "-smp", "1", "-m", "768",
        "-nodefaults", "-display", "none", "-serial", "stdio", "-no-reboot",
        "-kernel", str(CACHE / "vmlinuz"), "-initrd", str(out / "initial"),
        "-append", "console=ttyS0 quiet panic=-1 mitigations=off nokaslr random.trust_cpu=on",
        "-fsdev", f"{shared},id=root,path=/,readonly=on,multidevs=remap",
        "-device", "virtio-9p-pci,fsdev=root,mount_tag=root",
        "-fsdev", f"{shared},id=out,path={out}",
        "-device", "virtio-9p-pci,fsdev=out,mount_tag=out",
    ]  # fmt: skip
    ended = subprocess.run(  # noqa: S603
        machine, stdin=subprocess.DEVNULL, capture_output=True, timeout=timeout, check=False
    )
    output = (ended.stdout + ended.stderr).decode("utf-8", "replace").replace("\r", "")
    status = out / "status"
    return int(status.read_text()) if status.exists() else -1, output


def main(arguments: list[str]) -> int:
    """Run the command line."""
    counted = arguments[:1] != ["clock"]
    command, *more = arguments if counted else arguments[1:]
    if command == "fetch":
        fetch()
        return 0
    if (why := missing()) is not None:
        sys.stderr.write(f"{why}\n")
        return 1
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        status, output = run(Path(more[0]).resolve(), more[1:], out, timeout=300, counted=counted)
        sys.stdout.write(output)
        for one in out.glob("*.json"):
            shutil.copy(one, os.environ.get("OUT", "."))
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
