"""Hold GrTravis2/iv3, a client and a simulator in Go, against our emulated sensor and our client.

It is on no registry. Get it first, and Go (``apt install golang``)::

    git clone https://github.com/GrTravis2/iv3
    python -m scripts.judge_iv3 iv3

Its client asks the emulated sensor; our client asks its simulator, which listens on port 3333.
"""

from __future__ import annotations

import asyncio
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import smartcam
from smartcam.exceptions import SmartCamError
from smartcam.makes import EmulatedIv3

PROGRAM = """package main

import (
	"fmt"
	"os"
	"strconv"

	"iv3/Camera"
	"iv3/Messenger"
	"iv3/Operate"
	"iv3/Simulator"
)

func main() {
	camera := Camera.NewCamera([]int{127, 0, 0, 1})
	if os.Args[1] == "simulator" {
		Simulator.NewSimulator(camera, true).Run()
		return
	}
	port, _ := strconv.Atoi(os.Args[1])
	camera.SetPort(port)
	messenger := Messenger.NewMessenger("judge", camera)
	write, _ := Operate.ProgramWrite(1)
	wrong, _ := Operate.ProgramWrite(9)
	messages := []Messenger.Message{
		Operate.BlindTrig(), Operate.ReadResult(), Operate.Trig(),
		write, wrong, Operate.ProgramRead(),
	}
	for _, message := range messages {
		answer, err := messenger.Send("judge", message)
		fmt.Printf("%s %v %v %+v\\n", message.Compose(), answer.Ok(), err == nil, answer)
	}
}
"""

SAID = (
    "T1 false true &{prefix:T1",
    "RT true true",
    "T2 true true",
    "PW,1 true true",
    "PW,9 false true",
    "PR true",
)
"""Results of its client's calls of our sensor. The client keeps the CR, so an answer of one word
is no answer to it; the last but one is a program that is not there."""


JOINED = """package Operate

func joined(all ...error) error {
	for _, one := range all {
		if one != nil {
			return one
		}
	}
	return nil
}
"""


def for_debian(copy: Path) -> None:
    """Have a copy build with Debian's Go 1.19, which lacks errors.Join and CutSuffix."""
    (copy / "go.mod").write_text("module iv3\n\ngo 1.19\n")
    operate = copy / "Operate" / "Operate.go"
    text = operate.read_text().replace("errors.Join(", "joined(").replace('\t"errors"\n', "")
    operate.write_text(text)
    (copy / "Operate" / "joined.go").write_text(JOINED)
    simulator = copy / "Simulator" / "Simulator.go"
    newer, older = "msg, _ = strings.CutSuffix(msg,", "msg = strings.TrimSuffix(msg,"
    simulator.write_text(simulator.read_text().replace(newer, older))


async def their_client(program: Path) -> str:
    """Return what its client says of an emulated sensor."""
    async with EmulatedIv3(programs=(0, 1)) as camera:
        done = await asyncio.create_subprocess_exec(
            program, str(camera.port), stdout=asyncio.subprocess.PIPE
        )
        out, _ = await asyncio.wait_for(done.communicate(), 20)
    return out.decode()


async def our_client(program: Path) -> list[str]:
    """Return what our client says of its simulator."""
    simulator = await asyncio.create_subprocess_exec(
        program, "simulator", stdout=asyncio.subprocess.DEVNULL
    )
    try:
        layout = "count: uint32, passed: bool"
        async with smartcam.connect(
            "iv3://127.0.0.1:3333", interpret_as=layout, connect_attempts=20
        ) as camera:
            results = [await camera.trigger() for _ in range(3)]
            said = [f"{one.value.count} {one.value.passed}" for one in results]
            await camera.switch_application(99)
            said.append(f"program {await camera.query_application()}")
            return [*said, (await camera.request("DR,03,0") or b"").decode()]
    finally:
        simulator.kill()
        await simulator.wait()


def main(folder: str) -> int:
    """Build both and run them; return 0 where each says what it should."""
    with tempfile.TemporaryDirectory() as place:
        copy = Path(place) / "iv3"
        shutil.copytree(folder, copy)
        (copy / "main.go").write_text(PROGRAM)
        for_debian(copy)
        build = ["go", "build", "-o", "judge", "main.go"]
        subprocess.run(build, cwd=copy, check=True)  # noqa: S603
        said = asyncio.run(their_client(copy / "judge"))
        sys.stdout.write(f"{said}\n")
        try:
            ours = asyncio.run(our_client(copy / "judge"))
        except SmartCamError as exc:
            sys.stdout.write(f"{exc}\n")
            return 1
        sys.stdout.write(f"{ours}\n")
    lines = said.strip().split("\n")
    good = len(lines) == len(SAID) and all(map(str.startswith, lines, SAID))
    return 0 if good and ours == [*["0 False"] * 3, "program 99", "DR,03,0,0023250"] else 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
