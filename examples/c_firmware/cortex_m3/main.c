/* The firmware on the bare metal: whenever the other end of the UART opens the slcan channel, one run. */
#include "device.h"
#include "uart.h"

int main(void)
{
    uart_start();
    for (;;) {
        if (transport_slcan.open("slcan:")) {
            (void)device_run(&transport_slcan); /* however it ended, the next one begins with the roll call */
        }
        transport_slcan.close();
    }
}
