/* The serial port of a board. Replace board_mps2.c by functions for yours. */
#ifndef BOARD_H_
#define BOARD_H_

#include <stddef.h>

void board_read(void* to, size_t size); /* waits */
void board_write(const void* from, size_t size);

#endif /* BOARD_H_ */
