/* The firmware as a process: `firmware URL`, or the URL in the variable PUMPBENCH_BUS.
 *
 * It waits for the bench's roll call, does one run, and ends with it. Exit status: 0 the bench ended the run, 2 wrong
 * usage, 3 the bus could not be joined or was lost. */
#include <stdio.h>
#include <stdlib.h>

#include "protocol.h"
#include "transport.h"

static const struct transport *const TRANSPORTS[] = {&transport_hub, &transport_socketcan};

static struct firmware firmware;
static struct frame heard[TRANSPORT_BATCH];
static struct frame answer[FIRMWARE_FRAMES_AT_MOST];

static int run(const struct transport *bus)
{
    size_t n = 0u;
    firmware_start(&firmware, answer, &n);
    if (!bus->send(answer, n)) {
        return 3;
    }
    for (;;) {
        const size_t frames = bus->receive(heard);
        if (frames == 0u) {
            return 3;
        }
        for (size_t i = 0u; i < frames; i++) {
            const bool goes_on = firmware_receive(&firmware, &heard[i], answer, &n);
            if (n > 0u && !bus->send(answer, n)) {
                return 3;
            }
            if (!goes_on) {
                return 0;
            }
        }
    }
}

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
            const int status = bus->open(url) ? run(bus) : 3;
            bus->close();
            return status;
        }
    }
    fprintf(stderr, "firmware: %s: expected unix:/path, tcp:127.0.0.1:port, socketcan:vcan0 or stdio:\n", url);
    return 2;
}
