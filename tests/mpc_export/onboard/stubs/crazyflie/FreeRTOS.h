#pragma once
#define M2T(X) ((unsigned int)(X))
