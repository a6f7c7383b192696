/* How chip_play.c reads its stream and prints: port_host.c, or port_emulator.c under an
 * emulator. */
#ifndef PORT_H_
#define PORT_H_

#include <stddef.h>
#include <stdint.h>

void port_open(void);
void port_read(void* to, size_t size); /* ends the program at the end of the stream */
void port_print(const char* text);
void port_exit(int status);
uint32_t port_clock(void);
uint32_t port_since(uint32_t clock); /* instructions; 0 where they are not known */
uint32_t port_stack(void);           /* the most bytes of it since port_open; 0 if not known */

#endif /* PORT_H_ */
