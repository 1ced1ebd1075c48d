/* The driver behind serial.h. */
#ifndef UART_H
#define UART_H

/* Switch the UART and its interrupts on. */
void uart_start(void);

/* For the vector table. */
void uart_interrupt(void);

#endif
