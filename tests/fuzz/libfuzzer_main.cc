// The entry of libFuzzer.
#include "tests/fuzz/fuzz_target.h"

extern "C" int LLVMFuzzerTestOneInput(const uint8_t* data, size_t size) {
  spikeserve::FuzzOne({reinterpret_cast<const char*>(data), size});
  return 0;
}
