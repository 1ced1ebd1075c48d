/* From reset to main: the vector table, and memory as C expects it. */
#include <stdint.h>
#include <string.h>

#include "uart.h"

int main(void);
void reset(void);

/* link.ld has these; an address is all they are. */
extern uint8_t data_in_flash[], data_start[], data_end[], bss_start[], bss_end[], stack_top[];

void reset(void)
{
    memcpy(data_start, data_in_flash, (size_t)(data_end - data_start));
    memset(bss_start, 0, (size_t)(bss_end - bss_start));
    (void)main();
}

/* A fault of the program: it falls silent, and the bench's time-out names the step. */
static void halt(void)
{
    for (;;) {
        __asm__ volatile("wfi");
    }
}

union vector {
    uint8_t *stack;
    void (*handler)(void);
};

__attribute__((section(".vectors"), used)) static const union vector vectors[] = {
    {.stack = stack_top},
    {.handler = reset},
    {.handler = halt}, /* NMI */
    {.handler = halt}, /* HardFault, to which the faults below escalate as none is enabled */
    {.handler = halt}, /* MemManage */
    {.handler = halt}, /* BusFault */
    {.handler = halt}, /* UsageFault */
    {.handler = halt}, {.handler = halt}, {.handler = halt}, {.handler = halt}, /* reserved */
    {.handler = halt}, /* SVCall */
    {.handler = halt}, /* DebugMonitor */
    {.handler = halt}, /* reserved */
    {.handler = halt}, /* PendSV */
    {.handler = halt}, /* SysTick */
    {.handler = uart_interrupt}, /* IRQ 0: UART 0 has received */
    {.handler = uart_interrupt}, /* IRQ 1: UART 0 has sent */
};
