#include "server/base/shared_places.h"

#include <gtest/gtest.h>

#include <vector>

namespace spikeserve {
namespace {

using Places = std::vector<std::shared_ptr<SharedPlaces::Place>>;

// Takes places until there is none for the group. Returns how many.
size_t TakeAll(SharedPlaces& places, const std::string& group, Places* taken) {
  const size_t before = taken->size();
  while (auto place = places.Take(group)) taken->push_back(std::move(place));
  return taken->size() - before;
}

TEST(SharedPlacesTest, EachGroupLeavesRoomForAnother) {
  SharedPlaces places(16);
  Places taken;
  EXPECT_EQ(TakeAll(places, "first", &taken), 8u);
  EXPECT_EQ(TakeAll(places, "second", &taken), 4u);
  EXPECT_EQ(TakeAll(places, "third", &taken), 2u);
  EXPECT_EQ(TakeAll(places, "first", &taken), 0u);
}

TEST(SharedPlacesTest, PlacesAreGivenBack) {
  SharedPlaces places(16);
  for (int i = 0; i < 3; ++i) {
    Places taken;
    EXPECT_EQ(TakeAll(places, "first", &taken), 8u);
  }
}

TEST(SharedPlacesTest, PlacesMayOutliveTheObject) {
  std::shared_ptr<SharedPlaces::Place> place;
  {
    SharedPlaces places(2);
    place = places.Take("a");
  }
  EXPECT_NE(place, nullptr);
}

}  // namespace
}  // namespace spikeserve
