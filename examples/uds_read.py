"""Read a firmware's identification and trouble codes with udsoncan, over any bus of the bench.

The tester joins the bus that plant and firmware are on, at any time; a run goes on as if it were not there:

    pumpbench plant --host --bus unix:bench.sock --days 14 &
    pumpbench firmware --bus unix:bench.sock &
    python examples/uds_read.py hilbus unix:bench.sock

Needs the extra: pip install 'pumpbench[diagnostics]'.
"""

import sys

import can

try:
    import isotp
    from udsoncan import DidCodec
    from udsoncan.client import Client
    from udsoncan.connections import PythonIsoTpConnection
except ImportError as error:
    print(f"{error.name} is missing: pip install 'pumpbench[diagnostics]'", file=sys.stderr)
    sys.exit(2)

REQUEST_ID, RESPONSE_ID = 0x7E0, 0x7E8
TEXTS = {0xF18C: "serial number", 0xF190: "device", 0xF191: "hardware", 0xF195: "software"}
COUNTERS = {
    0x0110: "E2E errors",
    0x0111: "lost frames",
    0x0112: "sequence errors",
    0x0113: "saturations",
    0x0114: "NVM fallbacks",
    0x0115: "overruns",
    0x0116: "boots",
}
FAILED, FAILED_THIS_CYCLE, CONFIRMED, FAILED_SINCE_CLEAR = 0x01, 0x02, 0x08, 0x20


class Text(DidCodec):
    """ASCII of any length."""

    def decode(self, string_bin: bytes) -> str:
        return string_bin.decode("ascii")

    def __len__(self) -> int:
        raise DidCodec.ReadAllRemainingData


class Word(DidCodec):
    """An unsigned 16-bit number."""

    def decode(self, string_bin: bytes) -> int:
        return int.from_bytes(string_bin, "big")

    def __len__(self) -> int:
        return 2


def main(interface: str, channel: str) -> None:
    """Print what the firmware on this bus says of itself."""
    identifiers = dict.fromkeys(TEXTS, Text) | dict.fromkeys(COUNTERS, Word)
    with can.Bus(interface=interface, channel=channel) as bus:
        connection = PythonIsoTpConnection(
            isotp.CanStack(bus, address=isotp.Address(rxid=RESPONSE_ID, txid=REQUEST_ID))
        )
        with Client(connection, config={"data_identifiers": identifiers, "request_timeout": 5}) as client:
            for number, name in (TEXTS | COUNTERS).items():
                print(f"{name:16}{client.read_data_by_identifier_first(number)}")
            mask = FAILED | FAILED_THIS_CYCLE | CONFIRMED | FAILED_SINCE_CLEAR
            for code in client.get_dtc_by_status_mask(mask).service_data.dtcs:
                print(f"U30{code.id >> 8 & 0xFF:02X}-00        status 0x{code.status.get_byte_as_int():02X}")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        print("usage: uds_read.py INTERFACE CHANNEL, e.g. socketcan vcan0, or hilbus unix:bench.sock", file=sys.stderr)
        sys.exit(2)
    main(*sys.argv[1:])
