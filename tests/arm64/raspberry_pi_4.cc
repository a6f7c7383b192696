// Preloaded into an arm64 program, makes it believe that it runs on a Raspberry Pi 4, whose
// Cortex-A72 has NEON but no AES. Emulators have no such processor: their Cortex-A72
// has AES.
#include <dlfcn.h>

namespace {

constexpr unsigned long kHwcap = 16;                   // AT_HWCAP of <elf.h>
constexpr unsigned long kHwcap2 = 26;                  // AT_HWCAP2
constexpr unsigned long kFpAndAsimd = 1UL | 1UL << 1;  // HWCAP_FP and HWCAP_ASIMD of <asm/hwcap.h>
constexpr unsigned long kCrc32 = 1UL << 7;

}  // namespace

// Replaces the C library's.
extern "C" unsigned long getauxval(unsigned long type) {
  if (type == kHwcap) return kFpAndAsimd | kCrc32;
  if (type == kHwcap2) return 0;
  using Function = unsigned long (*)(unsigned long);
  static const auto original = reinterpret_cast<Function>(dlsym(RTLD_NEXT, "getauxval"));
  return original(type);
}
