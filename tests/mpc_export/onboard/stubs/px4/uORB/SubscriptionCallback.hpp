#pragma once
#include "Subscription.hpp"
