// Centres of dots by ViSP's vpDot2. Reads "file width height n", then n times "u v", where each is
// to a few pixels; the file holds grey values, a byte each. Gives n lines "u v", "nan nan" if lost.
#include <cstdio>
#include <fstream>
#include <iostream>
#include <string>
#include <visp3/blob/vpDot2.h>
#include <visp3/core/vpImage.h>

int main()
{
  std::string file;
  unsigned int width, height, count;
  while (std::cin >> file >> width >> height >> count) {
    vpImage<unsigned char> image(height, width);
    std::ifstream content(file, std::ios::binary);
    content.read(reinterpret_cast<char *>(image.bitmap), std::streamsize(width) * height);
    for (unsigned int number = 0; number < count; ++number) {
      double u, v;
      std::cin >> u >> v;
      vpDot2 dot;
      try {
        dot.initTracking(image, vpImagePoint(v, u));
        dot.track(image);
        std::printf("%.6f %.6f\n", dot.getCog().get_u(), dot.getCog().get_v());
      }
      catch (const vpException &) {
        std::puts("nan nan");
      }
    }
  }
}
