"""Use smartcam's own distribution, alone in an environment: what needs the others says which extra.

Run in a folder outside the checkout, with the README's path as the argument.
"""

import asyncio
import re
import subprocess
import sys
from pathlib import Path

from smartcam.doctor import examine
from smartcam.emulator import EmulatedCamera

TEST = """
async def test_camera(camera):
    assert (await camera.trigger(7)).value

def test_emulated(emulated_camera):
    assert emulated_camera.url.startswith("bvs://")
"""
OTHERS = {
    "frames list": "frames",
    "fleet list fleet://127.0.0.1": "fleet",
    "calibrate list": "calibration",
    "ros2 --help": "ros2",
    "status fleet://127.0.0.1/cam1": "fleet",
}


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", *command], capture_output=True, text=True, timeout=120, check=False
    )


async def readme(text: str) -> None:
    """Run the README's first example, with the address of an emulated camera."""
    code = re.search(r"```python\n(.*?)```", text, re.DOTALL).group(1)
    async with EmulatedCamera(seed=1) as emulator:
        code = code.replace("bvs://192.168.0.10", emulator.url)
        found = await asyncio.to_thread(subprocess.run, [sys.executable, "-c", code], check=True)
        assert found.returncode == 0
        findings = [one async for one in examine(emulator.url, seconds=0.5)]
        assert findings
        assert all(one.exit_code == 0 for one in findings), findings


def main(path: str) -> None:
    asyncio.run(readme(Path(path).read_text(encoding="utf-8")))
    demo = run("smartcam", "demo")
    assert demo.returncode == 0, demo.stderr
    for command, extra in OTHERS.items():
        said = run("smartcam", *command.split())
        assert said.returncode == 2, (command, said)
        assert f'pip install "smartcam[{extra}]"' in said.stderr, (command, said.stderr)
    Path("test_core.py").write_text(TEST, encoding="utf-8")
    tests = run("pytest", "-q", "-o", "asyncio_mode=auto", "test_core.py")
    assert tests.returncode == 0, tests.stdout
    print("smartcam alone:", tests.stdout.strip().splitlines()[-1])


main(*sys.argv[1:])
