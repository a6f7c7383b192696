/* How chip_play.c reads its stream and prints: port_host.c, or port_semihosting.c under an
 * emulator. */
#ifndef PORT_H_
#define PORT_H_

#include <stddef.h>

void port_open(void);
void port_read(void* to, size_t size); /* ends the program at the end of the stream */
void port_print(const char* text);
void port_exit(int status);

#endif /* PORT_H_ */
