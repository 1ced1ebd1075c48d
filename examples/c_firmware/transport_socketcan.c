/* Linux SocketCAN: vcan, or any adapter with a kernel driver. */
#define _DEFAULT_SOURCE /* SO_RCVBUFFORCE and the CAN headers are Linux' own */

#include <stdio.h>
#include <string.h>

#include "transport.h"

static bool socketcan_knows(const char *url)
{
    return strncmp(url, "socketcan:", 10u) == 0;
}

#ifdef __linux__

#include <errno.h>
#include <net/if.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include <linux/can.h>
#include <linux/can/raw.h>

#include "tables.h"

#define RECEIVE_BUFFER (8 << 20) /* a queue that holds a flood; the kernel's default holds 280 frames */
#define SEND_TRIES 5000          /* of 1 ms each: the transmit queue of a slow wire fills */

static int can = -1;

/* Only what is addressed to CTRL, in whatever format, and its own ids, which nobody else may use. */
static bool set_filters(void)
{
    struct can_filter filters[MESSAGES];
    for (unsigned i = 0u; i < MESSAGES; i++) {
        filters[i].can_id = MESSAGE[i].can_id;
        filters[i].can_mask = CAN_EFF_MASK;
    }
    const can_err_mask_t errors = CAN_ERR_MASK;
    return setsockopt(can, SOL_CAN_RAW, CAN_RAW_FILTER, filters, sizeof filters) == 0 &&
           setsockopt(can, SOL_CAN_RAW, CAN_RAW_ERR_FILTER, &errors, sizeof errors) == 0;
}

static bool socketcan_open(const char *url)
{
    struct sockaddr_can address = {.can_family = AF_CAN};
    const int size = RECEIVE_BUFFER;
    address.can_ifindex = (int)if_nametoindex(url + 10);
    if (address.can_ifindex == 0) {
        fprintf(stderr, "firmware: %s: there is no such CAN interface (ip link)\n", url);
        return false;
    }
    can = socket(PF_CAN, SOCK_RAW, CAN_RAW);
    if (can < 0 || !set_filters() || bind(can, (const struct sockaddr *)&address, sizeof address) != 0) {
        fprintf(stderr, "firmware: %s: %s\n", url, strerror(errno));
        return false;
    }
    if (setsockopt(can, SOL_SOCKET, SO_RCVBUFFORCE, &size, sizeof size) != 0) { /* for root alone */
        (void)setsockopt(can, SOL_SOCKET, SO_RCVBUF, &size, sizeof size);
    }
    return true;
}

static size_t socketcan_receive(struct frame frames[TRANSPORT_BATCH])
{
    struct can_frame record;
    size_t n = 0u;
    /* wait for the first frame only; a batch is what is there, so that nothing waits for what comes later */
    while (n < TRANSPORT_BATCH) {
        const ssize_t got = recv(can, &record, sizeof record, n == 0u ? 0 : MSG_DONTWAIT);
        if (got < 0 && errno == EINTR) {
            continue;
        }
        if (got != (ssize_t)sizeof record) {
            if (n == 0u) {
                fprintf(stderr, "firmware: the interface is gone (%s)\n", strerror(errno));
            }
            return n;
        }
        frames[n].can_id = record.can_id; /* the flag bits are Linux' own */
        frames[n].len = record.can_dlc;
        memcpy(frames[n].data, record.data, FRAME_DATA_MAX);
        n++;
    }
    return n;
}

static bool socketcan_send(const struct frame *frames, size_t n)
{
    for (size_t i = 0u; i < n; i++) {
        struct can_frame record;
        memset(&record, 0, sizeof record);
        record.can_id = frames[i].can_id;
        record.can_dlc = frames[i].len;
        memcpy(record.data, frames[i].data, FRAME_DATA_MAX);
        int tries = 0;
        while (write(can, &record, sizeof record) != (ssize_t)sizeof record) {
            const struct timespec pause = {.tv_sec = 0, .tv_nsec = 1000000};
            if ((errno != ENOBUFS && errno != EINTR) || ++tries == SEND_TRIES) {
                fprintf(stderr, "firmware: cannot send (%s)\n", strerror(errno));
                return false;
            }
            (void)nanosleep(&pause, NULL);
        }
    }
    return true;
}

static void socketcan_close(void)
{
    if (can >= 0) {
        (void)close(can);
    }
}

#else

static bool socketcan_open(const char *url)
{
    fprintf(stderr, "firmware: %s: SocketCAN is Linux'\n", url);
    return false;
}

static size_t socketcan_receive(struct frame frames[TRANSPORT_BATCH])
{
    (void)frames;
    return 0u;
}

static bool socketcan_send(const struct frame *frames, size_t n)
{
    (void)frames;
    (void)n;
    return false;
}

static void socketcan_close(void)
{
}

#endif

const struct transport transport_socketcan = {socketcan_knows, socketcan_open, socketcan_receive, socketcan_send,
                                              socketcan_close};
