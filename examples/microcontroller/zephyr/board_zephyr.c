/* The serial port of Zephyr's console, for main.c. */
#include <zephyr/device.h>
#include <zephyr/drivers/uart.h>

#include "board.h"

static const struct device* const uart = DEVICE_DT_GET(DT_CHOSEN(zephyr_console));

void board_read(void* to, size_t size) {
  unsigned char* byte = to;
  while (size > 0) {
    if (uart_poll_in(uart, byte) != 0) continue; /* nothing has arrived */
    ++byte;
    --size;
  }
}

void board_write(const void* from, size_t size) {
  const unsigned char* byte = from;
  while (size-- > 0) uart_poll_out(uart, *byte++);
}
