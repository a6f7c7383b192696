#include <array>
#include <cstdint>
#include <filesystem>
#include <iostream>
#include <memory>
#include <string>
#include <system_error>

#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "client/spikectl/commands.h"
#include "core/base/file.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/emit/emit_c.h"
#include "nlohmann/json.hpp"

namespace spikeserve {
namespace {

namespace fs = std::filesystem;

// What the folder is besides the source and its header.
enum class EmitKind { kPlain, kArduino, kZephyr };
constexpr std::array<EnumName<EmitKind>, 3> EnumNames(EmitKind) {
  return {{{EmitKind::kPlain, "plain"},
           {EmitKind::kArduino, "arduino"},
           {EmitKind::kZephyr, "zephyr"}}};
}

struct EmitFlags {
  std::string policy;
  std::string out;
  EmitKind kind = EmitKind::kPlain;
  int64_t ram = 0;
};

// Names the policy as a server does that serves NAME/VERSION/policy.safetensors; another file is
// version 1 of its own name.
EmitOptions Identify(const std::string& path) {
  const fs::path file = fs::absolute(path);
  EmitOptions options = {.name = file.stem().string()};
  int64_t version = 0;
  if (file.filename() != "policy.safetensors" ||
      !absl::SimpleAtoi(file.parent_path().filename().string(), &version) || version < 1) {
    return options;
  }
  options.name = file.parent_path().parent_path().filename().string();
  options.version = version;
  return options;
}

absl::Status WriteModule(const EmitFlags& flags, const EmitOptions& options) {
  const fs::path out = flags.out;
  if (flags.kind == EmitKind::kArduino) {
    return WriteFileAtomically(
        (out / "library.properties").string(),
        {"name=spike_policy\nversion=", std::to_string(options.version),
         ".0.0\nauthor=spikeserve\nmaintainer=spikeserve\n"
         "sentence=The policy ",
         options.name,
         ", a spiking decision transformer.\nparagraph=Made by spikectl emit-c.\n"
         "category=Data "
         "Processing\nurl=https://github.com/"
         "spikeserve\narchitectures=*\nincludes=spike_policy.h\n"});
  }
  RETURN_IF_ERROR(WriteFileAtomically(
      (out / "CMakeLists.txt").string(),
      {"zephyr_library_named(spike_policy)\nzephyr_library_sources(spike_policy.c)\n"
       "zephyr_include_directories(.)\n"}));
  return WriteFileAtomically((out / "zephyr" / "module.yml").string(),
                             {"name: spike_policy\nbuild:\n  cmake: .\n"});
}

absl::Status Run(const EmitFlags& flags, bool json) {
  if (flags.policy.empty()) return InvalidArgument("--policy", "a policy file", "none");
  if (flags.out.empty()) return InvalidArgument("--out", "a folder", "none");
  if (flags.ram < 0) return InvalidArgument("--ram", "at least 0", flags.ram);
  ASSIGN_OR_RETURN(const std::string bytes, ReadFile(flags.policy));
  EmitOptions options = Identify(flags.policy);
  options.most_state = flags.ram;
  const auto emitted = EmitC(bytes, options);
  if (!emitted.ok()) return Annotate(emitted.status(), flags.policy);
  std::error_code error;
  fs::create_directories(
      flags.kind == EmitKind::kZephyr ? fs::path(flags.out) / "zephyr" : fs::path(flags.out),
      error);
  if (error)
    return absl::InvalidArgumentError(
        absl::StrCat("--out: cannot make ", flags.out, ": ", error.message()));
  RETURN_IF_ERROR(
      WriteFileAtomically((fs::path(flags.out) / "spike_policy.h").string(), {emitted->header}));
  RETURN_IF_ERROR(
      WriteFileAtomically((fs::path(flags.out) / "spike_policy.c").string(), {emitted->source}));
  if (flags.kind != EmitKind::kPlain) RETURN_IF_ERROR(WriteModule(flags, options));
  if (json) {
    std::cout << nlohmann::ordered_json{{"policy", options.name},
                                        {"version", options.version},
                                        {"state_bytes", emitted->state_bytes},
                                        {"table_bytes", emitted->table_bytes}}
                     .dump(2)
              << "\n";
  } else {
    std::cout << options.name << " version " << options.version << ": " << emitted->table_bytes
              << " bytes of tables for the flash, " << emitted->state_bytes
              << " bytes of state for the RAM\n";
  }
  return absl::OkStatus();
}

}  // namespace

void AddEmitCommand(Command program, const ServerFlags& server) {
  const Command command =
      program.AddCommand("emit-c", "Writes a policy as C for a microcontroller");
  const auto flags = std::make_shared<EmitFlags>();
  command.Flags("Policy")
      .Add("policy", "FILE", &flags->policy, "The policy's file, in integer arithmetic")
      .Add("out", "DIR", &flags->out, "Folder for spike_policy.c and spike_policy.h")
      .Add("kind", EnumKind<EmitKind>(), &flags->kind,
           "Also makes the folder an Arduino library or a Zephyr module")
      .Add("ram", "BYTES", &flags->ram, "Refuses a policy whose state needs more; 0: none");
  command.SetAction([flags, &server] { return Run(*flags, server.json); });
}

}  // namespace spikeserve
