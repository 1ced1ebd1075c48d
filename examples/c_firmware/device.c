#include "device.h"

#include "protocol.h"

static struct firmware firmware;
static struct frame heard[TRANSPORT_BATCH];
static struct frame answer[FIRMWARE_FRAMES_AT_MOST];

bool device_run(const struct transport *bus)
{
    size_t n = 0u;
    firmware_start(&firmware, answer, &n);
    if (!bus->send(answer, n)) {
        return false;
    }
    for (;;) {
        const size_t frames = bus->receive(heard);
        if (frames == 0u) {
            return false;
        }
        for (size_t i = 0u; i < frames; i++) {
            const bool goes_on = firmware_receive(&firmware, &heard[i], answer, &n);
            if (n > 0u && !bus->send(answer, n)) {
                return false;
            }
            if (!goes_on) {
                return true;
            }
        }
    }
}
