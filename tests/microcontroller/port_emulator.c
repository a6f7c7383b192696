/* An emulated microcontroller: reset, semihosting, which reads the file `stream` of the emulator's
   folder, the stack and, with QEMU's -icount shift=0, the number of instructions.

   https://github.com/ARM-software/abi-aa/blob/main/semihosting/semihosting.rst */
#include <stdint.h>
#include <string.h>

#include "port.h"

enum { SYS_OPEN = 0x01, SYS_WRITE0 = 0x04, SYS_READ = 0x06, SYS_EXIT_EXTENDED = 0x20 };

extern uint32_t stack_bottom[], stack_top[]; /* of the linker's script */
int main(void);

static uint8_t buffer[256];
static size_t buffered, taken;
static uintptr_t file;

#if defined(__riscv)

static uintptr_t call_host(uintptr_t operation, const void* arguments) {
  register uintptr_t a0 __asm__("a0") = operation;
  register const void* a1 __asm__("a1") = arguments;
  __asm__ volatile(
      ".option push\n.option norvc\n.balign 16\nslli x0, x0, 0x1f\nebreak\nsrai x0, x0, 7\n.option "
      "pop"
      : "+r"(a0)
      : "r"(a1)
      : "memory");
  return a0;
}

__attribute__((naked, section(".reset"))) void reset(void) {
  __asm__ volatile("la sp, stack_top\ncall main\n1: j 1b");
}

uint32_t port_clock(void) {
  uint32_t instructions;
  __asm__ volatile(".option push\n.option arch, +zicsr\nrdinstret %0\n.option pop"
                   : "=r"(instructions));
  return instructions;
}

uint32_t port_since(uint32_t clock) { return port_clock() - clock; }

#else

#define SYSTICK ((volatile uint32_t*)0xe000e010u) /* control, reload, value */

static uintptr_t call_host(uintptr_t operation, const void* arguments) {
  register uintptr_t r0 __asm__("r0") = operation;
  register const void* r1 __asm__("r1") = arguments;
  __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
  return r0;
}

static void reset(void) {
#if defined(__ARM_FP)
  *(volatile uint32_t*)0xe000ed88u |= 0xfu << 20; /* the floating-point unit */
  __asm__ volatile("dsb\nisb");
#endif
  SYSTICK[1] = 0xffffff;
  SYSTICK[2] = 0;
  SYSTICK[0] = 5;
  main();
}

static void fault(void) {
  call_host(SYS_WRITE0, "fault\n");
  port_exit(3);
}

__attribute__((used, section(".reset"))) static const struct {
  uint32_t* stack;
  void (*handlers[6])(void);
} vectors = {stack_top, {reset, fault, fault, fault, fault, fault}};

uint32_t port_clock(void) { return SYSTICK[2]; }

uint32_t port_since(uint32_t clock) {
  return (uint32_t)((float)((clock - SYSTICK[2]) & 0xffffff) *
                    (float)TICK); /* ns are instructions */
}

#endif

void port_open(void) {
  const void* const arguments[] = {"stream", (void*)1 /* binary, to read */, (void*)6};
  uint32_t* word = stack_bottom;
  file = call_host(SYS_OPEN, arguments);
  /* Paints the stack below this function. */
  for (; word < (uint32_t*)__builtin_frame_address(0) - 64; ++word) *word = 0x5aa55aa5;
}

uint32_t port_stack(void) {
  const uint32_t* word = stack_bottom;
  while (*word == 0x5aa55aa5) ++word;
  return (uint32_t)((uintptr_t)stack_top - (uintptr_t)word);
}

void port_read(void* to, size_t size) {
  uint8_t* byte = to;
  while (size-- > 0) {
    if (taken == buffered) {
      const uintptr_t arguments[] = {file, (uintptr_t)buffer, sizeof(buffer)};
      buffered = sizeof(buffer) - call_host(SYS_READ, arguments);
      taken = 0;
      if (buffered == 0) port_exit(2);
    }
    *byte++ = buffer[taken++];
  }
}

void port_print(const char* text) { call_host(SYS_WRITE0, text); }

void port_exit(int status) {
  const uintptr_t arguments[] = {0x20026 /* the program has ended */, (uintptr_t)status};
  call_host(SYS_EXIT_EXTENDED, arguments);
  for (;;) continue;
}
