// Compiles the kernels of integer policies together, because Highway's headers take most of the
// time of each.
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "core/engine/spiking/kernels/integer_kernels.cc"
// clang-format off
#include "hwy/foreach_target.h"  // must come first: compiles the rest of this file once per target
// clang-format on
#include "core/engine/spiking/kernels/event_kernels-inl.h"
#include "core/engine/spiking/kernels/integer_attention_kernels-inl.h"
#include "core/engine/spiking/kernels/norm_kernel-inl.h"
