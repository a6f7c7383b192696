/* dense.c with the instructions of Cortex-M4, M7, M33 and M55 for two products at a time. */
#define DENSE_PAIRS 1
#include "dense.c"
