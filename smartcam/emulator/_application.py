"""Define applications, the programs that are stored on the emulated camera."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import BeforeValidator, ConfigDict, Field, model_validator

from smartcam._forks import cached_property
from smartcam._user_code import ENDS_PROGRAM
from smartcam.emulator._data import EmulatorData, Seconds
from smartcam.emulator._generators import Generator, Run, Values, find_generator, wrap_number
from smartcam.emulator._scene import TableScene
from smartcam.exceptions import ConfigurationError, SmartCamError
from smartcam.layout import Layout
from smartcam.settings import validated

if TYPE_CHECKING:
    from collections.abc import Mapping

    from smartcam.models import ByteOrder

MAX_CONTAINER_BYTES = 1 << 16
"""Largest number of bytes of a result container: about 64 kB (HALCON script manual p. 15,
published)."""


def _layout_text(value: object) -> object:
    return value.text if isinstance(value, Layout) else value


_LayoutText = Annotated[str, BeforeValidator(_layout_text)]


class Application(EmulatorData):
    """A program on the camera: its trigger, its duration, and the values that it sends.

    At most one of ``constant``, ``cycle`` and ``generator`` gives the values of the result
    container; without any of them the application has no "send results" tool and sends nothing.
    As a check, containers are built once when the application is made, so a generator is called.

    Raises:
        pydantic.ValidationError: a field is wrong, or its values do not fit the layout.
    """

    model_config: ClassVar[ConfigDict] = ConfigDict(arbitrary_types_allowed=True)

    id: int = Field(ge=1, le=0xFFFFFFFF, description="clients switch to this number; not 0")
    name: str = Field(default="", max_length=200, description="name that people see")
    layout: _LayoutText | None = Field(default=None, description="layout of the result container")
    rate: float | None = Field(
        default=None,
        ge=0.0001,
        le=1000,
        allow_inf_nan=False,
        description="runs per second of a free-running application; None: it waits for triggers",
    )
    load_time: Seconds = Field(
        default=0.3,
        description="seconds that a switch to it takes: several 100 ms (SC manual p. 34)",
    )
    processing_time: Seconds = Field(
        default=0.05,
        description=(
            "seconds from trigger to result; a free run ends when the next begins at the latest"
        ),
    )
    input: _LayoutText | None = Field(
        default=None,
        description='layout of the input data: one record; None: no "receive data" tool',
    )
    slots: int | None = Field(
        default=None, ge=0, le=65_535, description="records in the container, unused ones are zeros"
    )
    constant: dict[str, Any] | list[Any] | None = Field(
        default=None, description="the same values always"
    )
    cycle: list[dict[str, Any] | list[Any]] | None = Field(
        default=None, min_length=1, description="values of one run after the other, over and over"
    )
    generator: str | Generator | None = Field(
        default=None, description="a generator's name or function"
    )
    parameters: dict[str, Any] = Field(
        default_factory=dict[str, Any], description="for the generator"
    )

    @property
    def triggered(self) -> bool:
        """True if the application waits for triggers."""
        return self.rate is None

    @cached_property
    def result_layout(self) -> Layout | None:
        """The compiled layout of the result container."""
        return None if self.layout is None else Layout(self.layout)

    @cached_property
    def input_layout(self) -> Layout | None:
        """The compiled layout of the input data; any byte but zero is a true bool in it."""
        return None if self.input is None else Layout(self.input, lenient=True)

    @property
    def repeat_after(self) -> int | None:
        """Number of runs after which the results repeat; None if each run makes a new one."""
        layout = self.result_layout
        if layout is None or layout.sequence_field is not None or self.generator is not None:
            return None
        return 1 if self.cycle is None else len(self.cycle)

    def container(
        self,
        *,
        number: int,
        run_index: int,
        time: float,
        scene: TableScene,
        values: Mapping[str, Any] | None = None,
        byte_order: ByteOrder = "little",
    ) -> bytes | None:
        """Return the bytes of one run's result container, None without a "send results" tool.

        Args:
            number: the run's sequence number.
            run_index: number of runs of this application before this one, since it was loaded.
            time: seconds since the device was made.
            scene: the scene that the camera sees.
            values: values of the input container.
            byte_order: order of the bytes of a number.

        Raises:
            ConfigurationError: the values do not fit the layout.
            Exception: any error of a generator.
        """
        layout = self.result_layout
        if layout is None:
            return None
        run = Run(number, run_index, time, layout, scene, values, self.parameters)
        return self.container_of(self._values(run), number=number, byte_order=byte_order)

    def container_of(
        self, values: Values, *, number: int, byte_order: ByteOrder = "little"
    ) -> bytes | None:
        """Return the bytes of a container of values, None without a "send results" tool.

        Args:
            values: values of the layout's fields.
            number: the run's sequence number.
            byte_order: order of the bytes of a number.

        Raises:
            ConfigurationError: the values do not fit the layout.
        """
        layout = self.result_layout
        if layout is None:
            return None
        field = layout.sequence_field
        data = layout.build(
            values,
            byte_order,
            slots=self.slots,
            sequence=None if field is None else wrap_number(field, number),
        )
        if len(data) > MAX_CONTAINER_BYTES:
            raise ConfigurationError(
                f"application {self.id}: a container has at most {MAX_CONTAINER_BYTES} bytes, "
                f"these values make {len(data)}"
            )
        return data

    def _values(self, run: Run) -> Values:
        if self.constant is not None:
            return self.constant
        if self.cycle is not None:
            return self.cycle[run.run_index % len(self.cycle)]
        generator = self.generator
        if generator is None:
            raise ConfigurationError(f"application {self.id} has a layout and no values")
        return (find_generator(generator) if isinstance(generator, str) else generator)(run)

    @model_validator(mode="after")
    def _check(self) -> Application:
        sources = [
            name for name in ("constant", "cycle", "generator") if getattr(self, name) is not None
        ]
        if len(sources) > 1:
            raise ValueError(f"values come from one place, not from {' and '.join(sources)}")
        if sources and self.layout is None:
            raise ValueError(f"{sources[0]} needs a layout")
        if self.layout is not None and not sources:
            raise ValueError("a layout needs values: constant, cycle or generator")
        is_set = "processing_time" in self.model_fields_set  # the default need not fit the rate
        if is_set and self.rate is not None and self.processing_time * self.rate > 1:
            raise ValueError(
                f"a run of {self.processing_time} s does not fit a rate of {self.rate} per second"
            )
        if self.input_layout is not None and self.input_layout.repeat is not None:
            raise ValueError("input: input data is one record")
        if self.result_layout is not None:
            self._try_values()
        return self

    def _try_values(self) -> None:
        entries = self.cycle or ()
        for index in range(max(1, len(entries))):
            prefix = f"cycle.{index}: " if entries else ""
            try:
                self.container(number=0, run_index=index, time=0.0, scene=TableScene())
            except SmartCamError as exc:
                raise ValueError(f"{prefix}{exc}") from exc
            except ENDS_PROGRAM:
                raise
            except BaseException as exc:
                raise ValueError(f"the generator failed: {exc!r}") from exc


def make_application(given: Application | dict[str, Any]) -> Application:
    """Return ``given`` as an application.

    Raises:
        ConfigurationError: a field is wrong; the text names the application and the field.
    """
    if isinstance(given, Application):
        return given
    number = given.get("id", "?") if isinstance(given, dict) else repr(given)
    return validated(Application, given, f"application {number}")


LOCALIZATIONS = (
    "(feature_id: string[50], quality: real32, photo_index: int32, "
    "x: real32, y: real32, theta: real32)*"
)

BUILTIN_APPLICATIONS = (
    Application(
        id=1,
        name="three texts",
        layout="first: string[50], second: string[50], third: string[50]",
        constant={
            "first": "a short text",
            "second": "fifty characters fill this field to its very end!!",
            "third": "",
        },
    ),
    Application(
        id=3,
        name="part check",
        layout="passed: bool, count: int32, x: real32, y: real32, code: string[8]",
        constant={"passed": True, "count": 2, "x": 101.5, "y": -3.25, "code": "ABC"},
    ),
    Application(
        id=7,
        name="tangram",
        layout=LOCALIZATIONS,
        generator="tangram",
        processing_time=0.08,
        load_time=0.5,
    ),
    Application(
        id=9,
        name="counter",
        layout="n: int32 @sequence",
        generator="sequence",
        rate=20.0,
        processing_time=0.01,
    ),
    Application(
        id=21,
        name="greeting",
        layout="text: string[20]",
        constant={"text": "Hello World"},
    ),
)
"""Applications of every emulated camera by default: a text test, a part check, the
tangram table, a free-running counter, a greeting."""
