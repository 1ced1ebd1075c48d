/* The hub's stream of docs/protocol.md: 16 bytes of greeting each way, then struct can_frame after struct can_frame.
 *
 * `stdio:` is that stream without a hub and without a greeting: frames from a file into a firmware under a debugger. */
#define _POSIX_C_SOURCE 200809L

#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <sys/un.h>
#include <unistd.h>

#include "transport.h"

#define RECORD 16u
#define MAGIC "HILBUS\r\n"
#define VERSION 1u
#define GOODBYE_ID 0xFFFFFFFFu
#define GOODBYE_LEN 0xFFu
#define CLOSE_SECONDS 2

static int input = -1, output = -1;
static bool is_tcp;
static uint8_t buffer[TRANSPORT_BATCH * RECORD];
static size_t buffered; /* bytes, of which the last record may be a part */

static uint32_t little_endian(const uint8_t *bytes)
{
    return (uint32_t)bytes[0] | (uint32_t)bytes[1] << 8 | (uint32_t)bytes[2] << 16 | (uint32_t)bytes[3] << 24;
}

static bool write_all(const uint8_t *bytes, size_t size)
{
    while (size > 0u) {
        const ssize_t written =
            is_tcp || input == output ? send(output, bytes, size, MSG_NOSIGNAL) : write(output, bytes, size);
        if (written < 0 && errno == EINTR) {
            continue;
        }
        if (written <= 0) {
            fprintf(stderr, "firmware: the hub is gone (%s)\n", strerror(errno));
            return false;
        }
        bytes += written;
        size -= (size_t)written;
    }
    return true;
}

/* Wait until at least one record is in the buffer; false at the end of the stream. */
static bool fill(void)
{
    while (buffered < RECORD) {
        const ssize_t got = read(input, buffer + buffered, sizeof buffer - buffered);
        if (got < 0 && errno == EINTR) {
            continue;
        }
        if (got <= 0) {
            fprintf(stderr, "firmware: the bus has ended (%s)\n", got < 0 ? strerror(errno) : "end of the stream");
            return false;
        }
        buffered += (size_t)got;
    }
    return true;
}

static void drop(size_t size)
{
    buffered -= size;
    memmove(buffer, buffer + size, buffered);
}

static bool greet(void)
{
    uint8_t hello[RECORD] = {0};
    const uint32_t pid = (uint32_t)getpid();
    memcpy(hello, MAGIC, 8u);
    hello[8] = VERSION;
    for (unsigned i = 0u; i < 4u; i++) {
        hello[12u + i] = (uint8_t)(pid >> (8u * i));
    }
    if (!write_all(hello, sizeof hello) || !fill()) {
        return false;
    }
    if (memcmp(buffer, MAGIC, 8u) != 0 || buffer[8] != VERSION || buffer[9] != 0u) {
        fprintf(stderr, "firmware: refused, or what answers there is no hub of this protocol\n");
        return false;
    }
    drop(RECORD);
    return true;
}

static bool connect_to(const void *address, socklen_t size, int family, const char *url)
{
    input = output = socket(family, SOCK_STREAM, 0);
    if (input < 0 || connect(input, address, size) != 0) {
        fprintf(stderr, "firmware: %s: %s\n", url, strerror(errno));
        return false;
    }
    return true;
}

static bool open_unix(const char *url, const char *path)
{
    struct sockaddr_un address = {.sun_family = AF_UNIX};
    if (*path == '\0' || strlen(path) >= sizeof address.sun_path) {
        fprintf(stderr, "firmware: %s: expected unix:/path of a socket, at most %zu bytes\n", url,
                sizeof address.sun_path - 1u);
        return false;
    }
    memcpy(address.sun_path, path, strlen(path) + 1u);
    return connect_to(&address, sizeof address, AF_UNIX, url);
}

/* A hub has neither a password nor encryption: it is only reachable on this machine. */
static bool open_tcp(const char *url, const char *rest)
{
    const char *colon = strrchr(rest, ':');
    char *end = NULL;
    const long port = colon == NULL ? 0 : strtol(colon + 1, &end, 10);
    const size_t length = colon == NULL ? 0u : (size_t)(colon - rest);
    const int no_delay = 1;
    bool connected = false;
    is_tcp = true;
    if (port < 1 || port > 65535 || end == colon + 1 || *end != '\0') {
        fprintf(stderr, "firmware: %s: expected tcp:127.0.0.1:port\n", url);
        return false;
    }
    if (length == 5u && memcmp(rest, "[::1]", length) == 0) {
        struct sockaddr_in6 address = {.sin6_family = AF_INET6, .sin6_port = htons((uint16_t)port)};
        address.sin6_addr = in6addr_loopback;
        connected = connect_to(&address, sizeof address, AF_INET6, url);
    } else if (length == 9u && (memcmp(rest, "127.0.0.1", length) == 0 || memcmp(rest, "localhost", length) == 0)) {
        struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
        address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
        connected = connect_to(&address, sizeof address, AF_INET, url);
    } else {
        fprintf(stderr, "firmware: %s: expected tcp:127.0.0.1:port or tcp:[::1]:port\n", url);
    }
    return connected && setsockopt(input, IPPROTO_TCP, TCP_NODELAY, &no_delay, sizeof no_delay) == 0;
}

static bool hub_knows(const char *url)
{
    return strncmp(url, "unix:", 5u) == 0 || strncmp(url, "tcp:", 4u) == 0 || strcmp(url, "stdio:") == 0;
}

static bool hub_open(const char *url)
{
    if (strcmp(url, "stdio:") == 0) {
        input = STDIN_FILENO;
        output = STDOUT_FILENO;
        return true;
    }
    const bool connected = url[0] == 'u' ? open_unix(url, url + 5) : open_tcp(url, url + 4);
    return connected && greet();
}

/* Why no frame follows: a goodbye of the hub, or what no frame of classic CAN can be. */
static void tell_end(const uint8_t *record)
{
    if (little_endian(record) == GOODBYE_ID && record[4] == GOODBYE_LEN) {
        fprintf(stderr, "firmware: the hub ended the connection (reason %lu)\n",
                (unsigned long)little_endian(record + 8));
    } else {
        fprintf(stderr, "firmware: this is no frame of classic CAN: a length of %u\n", (unsigned)record[4]);
    }
}

static size_t hub_receive(struct frame frames[TRANSPORT_BATCH])
{
    if (!fill()) {
        return 0u;
    }
    size_t n = 0u;
    const uint8_t *record = buffer;
    for (; (n + 1u) * RECORD <= buffered && record[4] <= FRAME_DATA_MAX; record += RECORD) {
        frames[n].can_id = little_endian(record);
        frames[n].len = record[4];
        memcpy(frames[n].data, record + 8, FRAME_DATA_MAX);
        n++;
    }
    if (n == 0u) { /* what came before it has been heard in an earlier call */
        tell_end(record);
    }
    drop(n * RECORD);
    return n;
}

/* All frames in one write: the hub switches them together. */
static bool hub_send(const struct frame *frames, size_t n)
{
    while (n > 0u) {
        uint8_t records[TRANSPORT_BATCH * RECORD] = {0};
        const size_t batch = n < TRANSPORT_BATCH ? n : TRANSPORT_BATCH;
        for (size_t i = 0u; i < batch; i++) {
            uint8_t *record = records + i * RECORD;
            for (unsigned byte = 0u; byte < 4u; byte++) {
                record[byte] = (uint8_t)(frames[i].can_id >> (8u * byte));
            }
            record[4] = frames[i].len;
            memcpy(record + 8, frames[i].data, FRAME_DATA_MAX);
        }
        if (!write_all(records, batch * RECORD)) {
            return false;
        }
        frames += batch;
        n -= batch;
    }
    return true;
}

static void hub_close(void)
{
    if (is_tcp && input >= 0) {
        /* closing TCP with unread input throws unsent output away: wait until the hub has closed its side */
        const struct timeval limit = {.tv_sec = CLOSE_SECONDS, .tv_usec = 0};
        (void)setsockopt(input, SOL_SOCKET, SO_RCVTIMEO, &limit, sizeof limit);
        (void)shutdown(input, SHUT_WR);
        while (read(input, buffer, sizeof buffer) > 0) {
        }
    }
    if (input >= 0) {
        (void)close(input);
    }
}

const struct transport transport_hub = {hub_knows, hub_open, hub_receive, hub_send, hub_close};
