"""An interpreter for a camera that sends names and weights of parts."""

from smartcam.interpreters import Reader

RECORD = 14  # string[10] and real32


def weights(reader: Reader) -> dict[str, float]:
    """Return the weight of each part, kilograms."""
    return {
        reader.get_string(first_byte, 10): reader.get_real32(first_byte + 10)
        for first_byte in reader.records(RECORD)
    }
