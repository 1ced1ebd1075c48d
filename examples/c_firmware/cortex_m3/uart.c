/* The first UART of Arm's CMSDK as the serial line, driven by interrupts: nothing here polls, the processor sleeps.
 *
 * The UART holds one byte and has no flow control. A byte that finds the ring full stays in the UART: an emulator then
 * holds back the next one; a real line would overrun, and the frames' counters would tell. */
#include "uart.h"

#include "serial.h"

#define UART ((volatile struct uart *)0x40004000u)
#define NVIC_ISER0 (*(volatile uint32_t *)0xE000E100u)

#define STATE_TX_FULL 1u
#define STATE_RX_FULL 2u
#define CTRL_TX_ENABLE 1u
#define CTRL_RX_ENABLE 2u
#define CTRL_TX_INTERRUPT 4u
#define CTRL_RX_INTERRUPT 8u
#define INTERRUPT_TX 1u
#define INTERRUPT_RX 2u
#define IRQ_RX 0u
#define IRQ_TX 1u

#define CLOCK_HZ 25000000u
#define BAUD 115200u

#define RING 4096u /* a power of two; more than the longest turn of the bench, the calibration, has bytes */

struct uart {
    uint32_t data;
    uint32_t state;
    uint32_t ctrl;
    uint32_t interrupt; /* which ones are pending; writing a one clears it */
    uint32_t baud_divider;
};

static volatile uint8_t ring[RING];
static volatile uint32_t head, tail; /* bytes that came, bytes that were taken */

static void mask_interrupts(void)
{
    __asm__ volatile("cpsid i" ::: "memory");
}

static void unmask_interrupts(void)
{
    __asm__ volatile("cpsie i\n isb" ::: "memory");
}

/* A pending interrupt ends the sleep although it is masked: what is checked before cannot come true unnoticed. */
static void sleep_until_interrupt(void)
{
    __asm__ volatile("wfi" ::: "memory");
}

static void move_byte(void)
{
    if ((UART->state & STATE_RX_FULL) != 0u && head - tail < RING) {
        ring[head % RING] = (uint8_t)UART->data;
        head++;
    }
}

void uart_interrupt(void)
{
    UART->interrupt = INTERRUPT_RX | INTERRUPT_TX;
    move_byte();
}

void uart_start(void)
{
    UART->baud_divider = CLOCK_HZ / BAUD;
    UART->ctrl = CTRL_TX_ENABLE | CTRL_RX_ENABLE | CTRL_TX_INTERRUPT | CTRL_RX_INTERRUPT;
    NVIC_ISER0 = 1u << IRQ_RX | 1u << IRQ_TX;
}

size_t serial_read(uint8_t *bytes, size_t size)
{
    size_t n = 0u;
    mask_interrupts();
    while (head == tail) {
        sleep_until_interrupt();
        unmask_interrupts();
        mask_interrupts();
    }
    while (n < size && head != tail) {
        bytes[n++] = ring[tail % RING];
        tail++;
    }
    move_byte(); /* one that had found no room */
    unmask_interrupts();
    return n;
}

bool serial_write(const uint8_t *bytes, size_t size)
{
    for (size_t i = 0u; i < size; i++) {
        mask_interrupts();
        while ((UART->state & STATE_TX_FULL) != 0u) {
            sleep_until_interrupt();
            unmask_interrupts();
            mask_interrupts();
        }
        UART->data = bytes[i];
        unmask_interrupts();
    }
    return true;
}
