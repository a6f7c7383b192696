#include "core/fleet/head_entry.h"

#include <openssl/sha.h>

#include <cstddef>
#include <optional>
#include <utility>
#include <vector>

#include "absl/strings/escaping.h"
#include "absl/strings/numbers.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/strip.h"
#include "core/base/status.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"

namespace spikeserve {
namespace {

constexpr char kEntryFormat[] = "spikeserve.head_entry.v1";
constexpr size_t kFields = 7;

// Stands before the contributor of a session that is held out. No session and no tenant has it in
// its name. Entries of earlier releases have no mark, and count as contributing.
constexpr absl::string_view kHeldOutMark = "held out: ";
// Stands behind it, before the operators, each as "LENGTH:BYTES,", and a semicolon.
constexpr absl::string_view kOperatorsMark = "operators: ";

std::string OperatorsMark(const std::vector<std::string>& operators) {
  if (operators.empty()) return "";
  std::string mark(kOperatorsMark);
  for (const std::string& id : operators) absl::StrAppend(&mark, id.size(), ":", id, ",");
  return mark + ";";
}

// Removes the mark from the contributor. Returns nullopt if it is no such mark.
std::optional<std::vector<std::string>> TakeOperators(absl::string_view* contributor) {
  std::vector<std::string> operators;
  if (!absl::ConsumePrefix(contributor, kOperatorsMark)) return operators;
  while (!absl::ConsumePrefix(contributor, ";")) {
    const size_t colon = contributor->find(':');
    size_t length = 0;
    if (colon == contributor->npos || !absl::SimpleAtoi(contributor->substr(0, colon), &length) ||
        length >= contributor->size() - colon - 1) {
      return std::nullopt;
    }
    operators.emplace_back(contributor->substr(colon + 1, length));
    contributor->remove_prefix(colon + 1 + length);
    if (!absl::ConsumePrefix(contributor, ",")) return std::nullopt;
  }
  return operators;
}

}  // namespace

template <Is<HeadEntry> T, typename Visitor>
void VisitFields(T& entry, Visitor&& visit) {
  visit("kind", entry.kind);
  visit("session", entry.contribution.session);
  visit("episode", entry.contribution.episode);
  visit("head", entry.contribution.head);
  visit("contributor", entry.contribution.contributor);  // with the marks
  visit("delta", entry.contribution.delta);
  visit("episode_return", entry.contribution.episode_return);
}

std::string HeadEntryIdentity(const HeadEntry& entry) {
  std::string bytes;
  codec::Writer writer(&bytes);
  writer.Begin(kEntryFormat);
  CborWriter(&bytes).Array(kFields);
  writer.Write(entry.kind);
  writer.Write(entry.contribution.session);
  writer.Write(entry.contribution.episode);
  return bytes;
}

std::string SerializeHeadEntry(const HeadEntry& entry) {
  std::string bytes = HeadEntryIdentity(entry);
  codec::Writer writer(&bytes);
  writer.Write(entry.contribution.head);
  writer.Write(absl::StrCat(entry.contribution.held_out ? kHeldOutMark : "",
                            OperatorsMark(entry.contribution.operators),
                            entry.contribution.contributor));
  writer.Write(entry.contribution.delta);
  writer.Write(entry.contribution.episode_return);
  return bytes;
}

absl::StatusOr<HeadEntry> ParseHeadEntry(const std::string& bytes) {
  ASSIGN_OR_RETURN(HeadEntry entry, codec::Parse<HeadEntry>(bytes, "head entry", kEntryFormat));
  absl::string_view contributor = entry.contribution.contributor;
  entry.contribution.held_out = absl::ConsumePrefix(&contributor, kHeldOutMark);
  auto operators = TakeOperators(&contributor);
  if (!operators.has_value()) {
    return InvalidArgument("head entry.contributor", "operators as LENGTH:BYTES,", contributor);
  }
  entry.contribution.operators = *std::move(operators);
  entry.contribution.contributor = std::string(contributor);
  return entry;
}

std::string NextDigest(absl::string_view before, const LoggedEntry& entry) {
  // As the script computes it that appends an entry (redis_head_log.cc).
  const std::string text =
      absl::StrCat(before, "|", entry.position.number, "|", entry.members, "|", entry.bytes);
  unsigned char digest[SHA_DIGEST_LENGTH];
  SHA1(reinterpret_cast<const unsigned char*>(text.data()), text.size(), digest);
  return absl::BytesToHexString(
      absl::string_view(reinterpret_cast<const char*>(digest), sizeof(digest)));
}

}  // namespace spikeserve
