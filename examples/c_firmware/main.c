/* The firmware as a process: `firmware URL`, or the URL in the variable PUMPBENCH_BUS.
 *
 * It waits for the bench's roll call, does one run, and ends with it. Exit status: 0 the bench ended the run, 2 wrong
 * usage, 3 the bus could not be joined or was lost. */
#include <stdio.h>
#include <stdlib.h>

#include "device.h"
#include "transport.h"

static const struct transport *const TRANSPORTS[] = {&transport_hub, &transport_socketcan, &transport_slcan};

int main(int argc, char **argv)
{
    const char *url = argc == 2 ? argv[1] : getenv("PUMPBENCH_BUS");
    if (argc > 2 || url == NULL) {
        fprintf(stderr, "usage: %s URL, e.g. unix:/run/bench.sock, tcp:127.0.0.1:29536, socketcan:vcan0\n", argv[0]);
        return 2;
    }
    for (size_t i = 0u; i < sizeof TRANSPORTS / sizeof *TRANSPORTS; i++) {
        const struct transport *bus = TRANSPORTS[i];
        if (bus->knows(url)) {
            const int status = bus->open(url) && device_run(bus) ? 0 : 3;
            bus->close();
            return status;
        }
    }
    fprintf(stderr, "firmware: %s: expected unix:/path, tcp:127.0.0.1:port, socketcan:vcan0, stdio: or slcan:\n", url);
    return 2;
}
