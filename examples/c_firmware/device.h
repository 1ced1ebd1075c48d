/* One run on a bus: the loop around firmware_receive, the same on an operating system and without one. */
#ifndef DEVICE_H
#define DEVICE_H

#include <stdbool.h>

#include "transport.h"

/* Start the firmware on a bus that has been joined, and answer until the bench ends the run; false if the bus is lost. */
bool device_run(const struct transport *bus);

#endif
