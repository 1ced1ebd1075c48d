/* stdin and stdout as a serial line: the slcan transport under a debugger or a sanitizer. */
#define _POSIX_C_SOURCE 200809L

#include <errno.h>
#include <stdio.h>
#include <string.h>
#include <unistd.h>

#include "serial.h"

size_t serial_read(uint8_t *bytes, size_t size)
{
    for (;;) {
        const ssize_t got = read(STDIN_FILENO, bytes, size);
        if (got >= 0) {
            return (size_t)got;
        }
        if (errno != EINTR) {
            fprintf(stderr, "firmware: the serial line is gone (%s)\n", strerror(errno));
            return 0u;
        }
    }
}

bool serial_write(const uint8_t *bytes, size_t size)
{
    while (size > 0u) {
        const ssize_t written = write(STDOUT_FILENO, bytes, size);
        if (written < 0 && errno == EINTR) {
            continue;
        }
        if (written <= 0) {
            fprintf(stderr, "firmware: the serial line is gone (%s)\n", strerror(errno));
            return false;
        }
        bytes += written;
        size -= (size_t)written;
    }
    return true;
}
