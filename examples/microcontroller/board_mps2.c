/* Arm's MPS2 board with a Cortex-M4, which QEMU emulates as mps2-an386: reset, and the serial port.
 */
#include <stdint.h>

#include "board.h"

#define UART ((volatile uint32_t*)0x40004000u) /* data, state, control, interrupts, divider */
#define ACCESS_OF_COPROCESSORS (*(volatile uint32_t*)0xe000ed88u)
#define ENABLE_INTERRUPTS (*(volatile uint32_t*)0xe000e100u)
#define CLEAR_INTERRUPTS (*(volatile uint32_t*)0xe000e280u)

extern uint32_t stack_top[]; /* of mps2.ld */
int main(void);
void reset(void);

void reset(void) {
  ACCESS_OF_COPROCESSORS |= 0xfu << 20;  /* switches the floating-point unit on */
  __asm__ volatile("dsb\nisb\ncpsid i"); /* interrupts only wake the processor */
  ENABLE_INTERRUPTS = 1;
  UART[4] = 16;
  UART[2] = 1 | 2 | 8; /* sends, receives, and interrupts when a byte has arrived */
  main();
  for (;;) continue;
}

__attribute__((used, section(".vectors"))) static const struct {
  uint32_t* stack;
  void (*reset)(void);
} vectors = {stack_top, reset};

void board_read(void* to, size_t size) {
  uint8_t* byte = to;
  while (size-- > 0) {
    while ((UART[1] & 2) == 0) __asm__ volatile("wfi"); /* sleeps while nothing has arrived */
    *byte++ = (uint8_t)UART[0];
    UART[3] = 2;
    CLEAR_INTERRUPTS = 1;
  }
}

void board_write(const void* from, size_t size) {
  const uint8_t* byte = from;
  while (size-- > 0) {
    while ((UART[1] & 1) != 0) continue; /* the last byte is still there */
    UART[0] = *byte++;
  }
}
