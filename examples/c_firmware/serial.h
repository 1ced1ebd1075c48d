/* A serial line as the slcan transport needs it: serial_stdio.c, or the driver of a UART. */
#ifndef SERIAL_H
#define SERIAL_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Wait for a byte and take what is there, at most `size`; 0 when the line is gone, which a UART never is. */
size_t serial_read(uint8_t *bytes, size_t size);

/* Write everything; false when the line is gone. */
bool serial_write(const uint8_t *bytes, size_t size);

#endif
