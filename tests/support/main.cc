// The main program of all GoogleTest programs. ctest runs each test in a process of its own,
// several at once; here each gets a directory of its own for testing::TempDir(), so that tests of
// one fixture can use the same file names.
#include <gmock/gmock.h>

#include <cstdlib>

#include "tests/support/files.h"

int main(int argc, char** argv) {
  const spikeserve::TemporaryDirectory directory;
  setenv("TEST_TMPDIR", directory.path().c_str(), 1);
  testing::InitGoogleMock(&argc, argv);
  return RUN_ALL_TESTS();
}
