/* Calls nothing of a policy: what calls_all.c needs besides it. */
#include "spike_policy.h"

int main(void) { return 0; }
