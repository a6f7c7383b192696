#include "server/heads/head_entry.h"

#include <openssl/sha.h>

#include <algorithm>
#include <concepts>
#include <string>
#include <type_traits>
#include <utility>

#include "absl/strings/escaping.h"
#include "absl/strings/str_cat.h"
#include "absl/strings/string_view.h"
#include "absl/strings/strip.h"
#include "core/base/status_macros.h"
#include "core/journal/field_codec.h"

namespace spikeserve {
namespace {

constexpr char kEntryFormat[] = "spikeserve.head_entry.v1";

// Stands before the contributor of a session that is held out. No session and no tenant has it in
// its name. Entries of earlier releases have no mark, and count as contributing.
constexpr char kHeldOutMark[] = "held out: ";

}  // namespace

template <typename T, typename Visitor>
requires std::same_as<std::remove_const_t<T>, HeadEntry>
void VisitFields(T& entry, Visitor&& visit) {
  visit("kind", entry.kind);
  visit("session", entry.session);
  visit("episode", entry.episode);
  visit("head", entry.head);
  visit("contributor", entry.contributor);  // with kHeldOutMark
  visit("delta", entry.delta);
  visit("episode_return", entry.episode_return);
}

std::string SerializeHeadEntry(const HeadEntry& entry) {
  HeadEntry marked = entry;
  if (entry.held_out) marked.contributor.insert(0, kHeldOutMark);
  std::string bytes;
  codec::Writer writer(&bytes);
  writer.Begin(kEntryFormat);
  writer.Write(marked);
  return bytes;
}

std::string HeadEntryIdentity(const HeadEntry& entry) {
  // The forms of two entries with different heads differ from the head on, which follows the
  // episode: the length of a text comes before it.
  const auto with_head = [&](std::string head) {
    return SerializeHeadEntry({.kind = entry.kind,
                               .session = entry.session,
                               .episode = entry.episode,
                               .head = std::move(head),
                               .contributor = "",
                               .delta = {}});
  };
  const std::string first = with_head("");
  const std::string second = with_head("other");
  return {first.begin(), std::ranges::mismatch(first, second).in1};
}

absl::StatusOr<HeadEntry> ParseHeadEntry(const std::string& bytes) {
  ASSIGN_OR_RETURN(const auto json, codec::ParseDocument(bytes, "head entry", kEntryFormat));
  HeadEntry entry;
  codec::Reader reader;
  reader.Read(json, "head entry", entry);
  if (!reader.status().ok()) return reader.status();
  absl::string_view contributor = entry.contributor;
  entry.held_out = absl::ConsumePrefix(&contributor, kHeldOutMark);
  entry.contributor = std::string(contributor);
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
