// A plugin of qemu 7.2 to 8: prints how many instructions each function of a program executed, the
// most first. Counts the instructions of the program, not those of the emulation.
//
//   gcc -shared -fPIC -O2 -o count_instructions.so count_instructions.c
//   qemu-aarch64 -plugin ./count_instructions.so -d plugin PROGRAM
//
// The declarations are those of qemu's qemu-plugin.h, API version 1, which Debian ships in no package.
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

struct qemu_plugin_tb;
struct qemu_plugin_insn;
struct qemu_info;
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb* block);
struct qemu_plugin_insn* qemu_plugin_tb_get_insn(const struct qemu_plugin_tb* block, size_t index);
const char* qemu_plugin_insn_symbol(const struct qemu_plugin_insn* instruction);
void qemu_plugin_register_vcpu_tb_trans_cb(uint64_t id, void (*callback)(uint64_t, struct qemu_plugin_tb*));
void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb* block, int add, void* counter, uint64_t by);
void qemu_plugin_register_atexit_cb(uint64_t id, void (*callback)(uint64_t, void*), void* data);
void qemu_plugin_outs(const char* text);

__attribute__((visibility("default"))) int qemu_plugin_version = 1;

enum { kMostFunctions = 1 << 16 };
struct Function {
  const char* symbol;
  uint64_t instructions;
};
static struct Function functions[kMostFunctions];
static int size;

// Returns the entry of a symbol. qemu translates blocks under a lock and keeps the names.
static struct Function* Find(const char* symbol) {
  if (symbol == NULL) symbol = "(unknown)";
  for (int i = 0; i < size; ++i) {
    if (strcmp(functions[i].symbol, symbol) == 0) return &functions[i];
  }
  if (size == kMostFunctions) abort();
  functions[size].symbol = symbol;
  return &functions[size++];
}

static void OnTranslation(uint64_t id, struct qemu_plugin_tb* block) {
  (void)id;
  struct Function* function = Find(qemu_plugin_insn_symbol(qemu_plugin_tb_get_insn(block, 0)));
  qemu_plugin_register_vcpu_tb_exec_inline(block, 0, &function->instructions, qemu_plugin_tb_n_insns(block));
}

static int Descending(const void* left, const void* right) {
  const uint64_t a = ((const struct Function*)left)->instructions;
  const uint64_t b = ((const struct Function*)right)->instructions;
  return (a < b) - (a > b);
}

static void OnExit(uint64_t id, void* data) {
  (void)id, (void)data;
  qsort(functions, (size_t)size, sizeof(functions[0]), Descending);
  for (int i = 0; i < size && functions[i].instructions > 0; ++i) {
    char line[4096];
    snprintf(line, sizeof(line), "instructions %llu %s\n", (unsigned long long)functions[i].instructions,
             functions[i].symbol);
    qemu_plugin_outs(line);
  }
}

__attribute__((visibility("default"))) int qemu_plugin_install(uint64_t id, const struct qemu_info* info, int count,
                                                               char** arguments) {
  (void)info, (void)count, (void)arguments;
  qemu_plugin_register_vcpu_tb_trans_cb(id, OnTranslation);
  qemu_plugin_register_atexit_cb(id, OnExit, NULL);
  return 0;
}
