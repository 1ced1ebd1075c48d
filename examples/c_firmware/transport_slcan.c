/* slcan, the LAWICEL text protocol: what the other end takes for a USB-CAN adapter is adapter and device in one.
 *
 * A line ends with CR. `O` opens the channel, `C` closes it, `tIIILDD...` is a data frame of an 11-bit identifier, T one of
 * 29 bits, r and R are remote frames. Commands are answered with CR, what cannot be done with BEL. A frame is not
 * answered: nobody waits for it, and it would double the bytes on the line. */
#include <string.h>

#include "serial.h"
#include "transport.h"

#define CR 0x0Du
#define BEL 0x07u
#define STANDARD_DIGITS 3u
#define EXTENDED_DIGITS 8u
#define STANDARD_ID_MASK 0x7FFu
#define LINE_MAX_LENGTH (1u + EXTENDED_DIGITS + 1u + 2u * FRAME_DATA_MAX) /* without its CR */

/* A channel in use that is opened again without having been closed belongs to a new bench: the one before was killed.
 * One that nobody has used yet may be opened twice: python-can does. */
static enum { CLOSED, OPEN, IN_USE, OPENED_AGAIN } channel;

static uint8_t input[256];
static size_t taken, filled; /* of the input */

static uint8_t line[LINE_MAX_LENGTH];
static size_t length; /* LINE_MAX_LENGTH + 1 for a line that is longer */

/* ---- lines out */

static void answer(uint8_t byte)
{
    (void)serial_write(&byte, 1u); /* if the line is gone, the next read says so */
}

static uint8_t digit(uint32_t value)
{
    return (uint8_t)"0123456789ABCDEF"[value & 15u];
}

static bool write_frame(const struct frame *frame)
{
    uint8_t text[LINE_MAX_LENGTH + 1u];
    const bool extended = (frame->can_id & FRAME_EXTENDED) != 0u;
    const bool remote = (frame->can_id & FRAME_REMOTE) != 0u;
    const size_t digits = extended ? EXTENDED_DIGITS : STANDARD_DIGITS;
    size_t n = 0u;
    text[n++] = (uint8_t)(remote ? (extended ? 'R' : 'r') : (extended ? 'T' : 't'));
    for (size_t i = digits; i-- > 0u;) {
        text[n++] = digit((frame->can_id & FRAME_ID_MASK) >> (4u * i));
    }
    text[n++] = digit(frame->len);
    for (size_t i = 0u; i < frame->len && !remote; i++) {
        text[n++] = digit((uint32_t)frame->data[i] >> 4);
        text[n++] = digit(frame->data[i]);
    }
    text[n++] = CR;
    return serial_write(text, n);
}

/* ---- lines in */

/* Read hexadecimal digits; false if there is another character, or the line ends before. */
static bool read_hex(size_t from, size_t digits, uint32_t *value)
{
    *value = 0u;
    if (from + digits > length) {
        return false;
    }
    for (size_t i = from; i < from + digits; i++) {
        const uint8_t c = line[i];
        uint32_t nibble;
        if (c >= '0' && c <= '9') {
            nibble = (uint32_t)c - '0';
        } else if (c >= 'A' && c <= 'F') {
            nibble = (uint32_t)c - 'A' + 10u;
        } else if (c >= 'a' && c <= 'f') {
            nibble = (uint32_t)c - 'a' + 10u;
        } else {
            return false;
        }
        *value = *value << 4 | nibble;
    }
    return true;
}

/* The frame in the line; false if there is none, or more than one. */
static bool read_frame(struct frame *frame)
{
    const bool extended = line[0] == 'T' || line[0] == 'R';
    const bool remote = line[0] == 'r' || line[0] == 'R';
    const size_t digits = extended ? EXTENDED_DIGITS : STANDARD_DIGITS;
    uint32_t identifier, size, byte;
    if (!read_hex(1u, digits, &identifier) || identifier > (extended ? FRAME_ID_MASK : STANDARD_ID_MASK) ||
        !read_hex(1u + digits, 1u, &size) || size > FRAME_DATA_MAX) {
        return false;
    }
    if (length != 2u + digits + (remote ? 0u : 2u * size)) {
        return false;
    }
    memset(frame, 0, sizeof *frame);
    frame->can_id = identifier | (extended ? FRAME_EXTENDED : 0u) | (remote ? FRAME_REMOTE : 0u);
    frame->len = (uint8_t)size;
    for (size_t i = 0u; i < size && !remote; i++) {
        if (!read_hex(2u + digits + 2u * i, 2u, &byte)) {
            return false;
        }
        frame->data[i] = (uint8_t)byte;
    }
    return true;
}

static bool is_open(void)
{
    return channel == OPEN || channel == IN_USE;
}

/* Obey the line; true if it is a frame, and the channel is open. */
static bool read_line(struct frame *frame)
{
    if (length > LINE_MAX_LENGTH) {
        answer(BEL);
        return false;
    }
    switch (length == 0u ? CR : line[0]) {
    case 't':
    case 'T':
    case 'r':
    case 'R':
        if (is_open() && read_frame(frame)) {
            channel = IN_USE;
            return true;
        }
        answer(BEL);
        return false;
    case 'O':
        channel = channel == IN_USE || channel == OPENED_AGAIN ? OPENED_AGAIN : OPEN;
        break;
    case 'C':
        channel = CLOSED;
        break;
    case 'V':
        (void)serial_write((const uint8_t *)"V0101", 5u);
        break;
    case 'S': /* the bit rate; there is no bus behind this line that had one */
    case 's':
    case CR:
        break;
    default:
        answer(BEL);
        return false;
    }
    answer(CR);
    return false;
}

/* Take a character; true if it completes a frame. */
static bool take(uint8_t c, struct frame *frame)
{
    if (c != CR) {
        if (length < LINE_MAX_LENGTH) {
            line[length] = c;
        }
        length += length <= LINE_MAX_LENGTH ? 1u : 0u;
        return false;
    }
    const bool is_frame = read_line(frame);
    length = 0u;
    return is_frame;
}

static bool fill(void)
{
    if (taken == filled) {
        taken = 0u;
        filled = serial_read(input, sizeof input);
    }
    return filled > 0u;
}

/* ---- the transport */

static bool slcan_knows(const char *url)
{
    return strcmp(url, "slcan:") == 0;
}

/* Wait until the other end opens the channel. */
static bool slcan_open(const char *url)
{
    struct frame nobodys;
    (void)url;
    while (channel == CLOSED) {
        if (!fill()) {
            return false;
        }
        (void)take(input[taken++], &nobodys);
    }
    channel = OPEN;
    return true;
}

/* One frame at a time, so that a command is answered in its place, after the frames before it. */
static size_t slcan_receive(struct frame frames[TRANSPORT_BATCH])
{
    while (is_open()) {
        if (!fill()) {
            return 0u;
        }
        if (take(input[taken++], &frames[0])) {
            return 1u;
        }
    }
    return 0u;
}

static bool slcan_send(const struct frame *frames, size_t n)
{
    for (size_t i = 0u; i < n; i++) {
        if (!write_frame(&frames[i])) {
            return false;
        }
    }
    return true;
}

/* The run is over for this device, the other end will close the channel some time. */
static void slcan_close(void)
{
    if (is_open()) {
        channel = CLOSED;
    }
}

const struct transport transport_slcan = {slcan_knows, slcan_open, slcan_receive, slcan_send, slcan_close};
