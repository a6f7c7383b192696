// Lists the members of a struct once, for its writer and its reader. The order of a list and its
// names may be part of a format.
//
//   SPIKESERVE_FIELDS(Timestep, return_to_go, observation, action)
//
// defines VisitFields(timestep, visit), which calls visit("return_to_go", timestep.return_to_go)
// and so on, for a Timestep or a const Timestep. It stands in the namespace of the struct.
#pragma once

#include <concepts>
#include <type_traits>

#include "nlohmann/json.hpp"

namespace spikeserve {

template <typename T, typename S>
concept Is = std::same_as<std::remove_const_t<T>, S>;

template <typename T>
concept HasFields = requires(T& value) {
  VisitFields(value, [](const char*, auto&) {});
};
template <typename T>
concept MayHaveMoreFields = requires(T& value) {
  VisitMoreFields(value, [](const char*, auto&) {});
};

}  // namespace spikeserve

#define SPIKESERVE_FIELDS(Struct, ...) SPIKESERVE_VISITOR(VisitFields, Struct, __VA_ARGS__)

// Defines VisitMoreFields() for optional members at the end, of which the writer writes the first
// MoreFields(value), so that releases which do not know the others can read these.
#define SPIKESERVE_MORE_FIELDS(Struct, ...) SPIKESERVE_VISITOR(VisitMoreFields, Struct, __VA_ARGS__)

// Defines such a function under another name, for some of the members.
#define SPIKESERVE_VISITOR(Name, Struct, ...)                                \
  template <::spikeserve::Is<Struct> T, typename Visitor>                    \
  void Name(T& value, Visitor&& visit) {                                     \
    NLOHMANN_JSON_EXPAND(NLOHMANN_JSON_PASTE(SPIKESERVE_VISIT, __VA_ARGS__)) \
  }
#define SPIKESERVE_VISIT(member) visit(#member, value.member);
