/* Standard input and output. */
#include <stdio.h>
#include <stdlib.h>

#include "port.h"

void port_open(void) {}

void port_read(void* to, size_t size) {
  if (fread(to, 1, size, stdin) == size) return;
  fputs("the stream has ended\n", stderr);
  exit(2);
}

void port_print(const char* text) {
  fputs(text, stdout);
  fflush(stdout); /* the caller may wait for it */
}

void port_exit(int status) { exit(status); }

uint32_t port_clock(void) { return 0; }

uint32_t port_since(uint32_t clock) { return clock; }

uint32_t port_stack(void) { return 0; }
