// Rewrites the file of golden answers and prints which entries changed.
//
// usage: rewrite_golden POLICIES FILE
#include <iostream>

#include "tests/golden/golden_answers.h"

int main(int argc, char** argv) {
  using spikeserve::golden::Answers;
  if (argc != 3) {
    std::cerr << "usage: " << argv[0] << " POLICIES FILE\n";
    return 2;
  }
  const Answers before = spikeserve::golden::ReadAnswers(argv[2]);
  const Answers after = spikeserve::golden::HashAll(argv[1]);
  int changes = 0;
  for (const auto& [name, hash] : after) {
    const auto old = before.find(name);
    if (old != before.end() && old->second == hash) continue;
    std::cout << (old == before.end() ? "new: " : "changed: ") << name << '\n';
    ++changes;
  }
  for (const auto& [name, hash] : before) {
    if (after.contains(name)) continue;
    std::cout << "removed: " << name << '\n';
    ++changes;
  }
  spikeserve::golden::WriteAnswers(argv[2], after);
  std::cout << changes << " of " << after.size() << " entries changed\n";
}
